"""The same as `wearcap prepare cmu`: python data_prep/cmu.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["bvh", *sys.argv[1:]]))
