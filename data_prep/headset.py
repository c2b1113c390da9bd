"""The same as `wearcap prepare headset`: python data_prep/headset.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["headset", *sys.argv[1:]]))
