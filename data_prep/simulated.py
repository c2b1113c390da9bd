"""The same as `wearcap prepare simulated`: python data_prep/simulated.py preset=demo [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["simulated", *sys.argv[1:]]))
