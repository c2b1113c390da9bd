"""The same as `wearcap prepare hcontact`: python data_prep/hcontact.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["hcontact", *sys.argv[1:]]))
