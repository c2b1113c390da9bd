"""The same as `wearcap prepare hdm05`: python data_prep/hdm05.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["hdm05", *sys.argv[1:]]))
