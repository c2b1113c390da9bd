"""The same as `wearcap prepare watches`: python data_prep/watches.py left=CSV right=CSV camera=TRAJECTORY [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["watches", *sys.argv[1:]]))
