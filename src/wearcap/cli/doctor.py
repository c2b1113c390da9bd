"""`wearcap doctor`: examine recordings and report problems and how to fix them."""

import sys

from wearcap.cli.stated import add_conventions
from wearcap.cli.verbs import VERBS, Arguments


def main(arguments: list[str]) -> None:
    """Exit code 1 when errors were found, else 0."""
    parser = Arguments(prog="wearcap doctor", description=VERBS["doctor"])
    parser.add_argument(
        "path",
        help="data set folder, DATASET/NAME, recording file, Aria MPS folder, scene folder, environment.json, motion capture file or folder, watch log, trajectory, headset log, or a folder with such logs of one session",
    )
    parser.add_argument(
        "--for", dest="pipeline", metavar="PIPELINE", help="what does hps, ireplica, hmd2, mocap_every or echo lack?"
    )
    add_conventions(parser)
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.add_argument("--quiet", action="store_true", help="leave out what is sound")
    options = parser.parse_args(arguments)

    from wearcap.cli.doctor_report import examined

    if not examined(options).sound:
        sys.exit(1)
