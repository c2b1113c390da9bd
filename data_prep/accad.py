"""The same as `wearcap prepare accad`: python data_prep/accad.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["accad", *sys.argv[1:]]))
