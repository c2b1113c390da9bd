"""The same as `wearcap prepare hps`: python data_prep/hps.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["hps", *sys.argv[1:]]))
