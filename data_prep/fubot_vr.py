"""The same as `wearcap prepare fubot_vr`: python data_prep/fubot_vr.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["fubot_vr", *sys.argv[1:]]))
