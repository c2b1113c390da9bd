"""The same as `wearcap prepare aria`: python data_prep/aria.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["aria", *sys.argv[1:]]))
