"""The same as `wearcap prepare simulated_interactions`: python data_prep/simulated_interactions.py preset=quick [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["simulated_interactions", *sys.argv[1:]]))
