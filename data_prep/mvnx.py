"""The same as `wearcap prepare mvnx`: python data_prep/mvnx.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["mvnx", *sys.argv[1:]]))
