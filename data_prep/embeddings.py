"""The same as `wearcap prepare embeddings`: python data_prep/embeddings.py dataset=DIR [key=value …]"""

import sys

from wearcap.cli.main import run_verb

if __name__ == "__main__":
    sys.exit(run_verb("prepare", ["embeddings", *sys.argv[1:]]))
