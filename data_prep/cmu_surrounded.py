"""The same as `wearcap prepare cmu_surrounded`: python data_prep/cmu_surrounded.py source=datasets/cmu [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["cmu_surrounded", *sys.argv[1:]]))
