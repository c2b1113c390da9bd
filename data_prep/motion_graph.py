"""The same as `wearcap prepare motion_graph`: python data_prep/motion_graph.py [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["motion_graph", *sys.argv[1:]]))
