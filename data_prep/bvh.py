"""The same as `wearcap prepare bvh`: python data_prep/bvh.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["bvh", *sys.argv[1:]]))
