"""The same as `wearcap prepare ui_prmd`: python data_prep/ui_prmd.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["ui_prmd", *sys.argv[1:]]))
