"""The same as `wearcap prepare amass`: python data_prep/amass.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["amass", *sys.argv[1:]]))
