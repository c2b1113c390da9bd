"""The same as `wearcap prepare omomo`: python data_prep/omomo.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["omomo", *sys.argv[1:]]))
