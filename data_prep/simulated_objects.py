"""The same as `wearcap prepare simulated_objects`: python data_prep/simulated_objects.py preset=quick [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["simulated_objects", *sys.argv[1:]]))
