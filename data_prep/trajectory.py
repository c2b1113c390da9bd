"""The same as `wearcap prepare trajectory`: python data_prep/trajectory.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["trajectory", *sys.argv[1:]]))
