"""The same as `wearcap prepare egohoi`: python data_prep/egohoi.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["egohoi", *sys.argv[1:]]))
