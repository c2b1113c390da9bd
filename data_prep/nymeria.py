"""The same as `wearcap prepare nymeria`: python data_prep/nymeria.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["nymeria", *sys.argv[1:]]))
