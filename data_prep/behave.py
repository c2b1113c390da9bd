"""The same as `wearcap prepare behave`: python data_prep/behave.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["behave", *sys.argv[1:]]))
