"""The same as `wearcap prepare markers`: python data_prep/markers.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["markers", *sys.argv[1:]]))
