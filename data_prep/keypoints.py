"""The same as `wearcap prepare keypoints`: python data_prep/keypoints.py dataset=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["keypoints", *sys.argv[1:]]))
