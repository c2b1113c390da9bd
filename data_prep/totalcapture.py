"""The same as `wearcap prepare totalcapture`: python data_prep/totalcapture.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["totalcapture", *sys.argv[1:]]))
