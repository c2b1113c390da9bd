"""The same as `wearcap prepare mocap_every_folder`: python data_prep/mocap_every_folder.py source=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["mocap_every_folder", *sys.argv[1:]]))
