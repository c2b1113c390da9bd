"""The same as `wearcap prepare berkeley_mhad`: python data_prep/berkeley_mhad.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["berkeley_mhad", *sys.argv[1:]]))
