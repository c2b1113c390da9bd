"""A live capture with an exported model, without Lightning, Hydra and the checkpoint.

python -m wearcap.apps.live MODEL.onnx --source vmc://:39540 --to vmc://127.0.0.1:39539 [--record DIR] [--height METRES]
"""

import argparse
import math
import sys
from pathlib import Path

from wearcap.apps.live.capture import LiveCapture, report_text
from wearcap.apps.live.setup import Known
from wearcap.apps.live.sinks import sink_of
from wearcap.apps.live.sources import sources_of
from wearcap.boundary.own import trusting
from wearcap.errors import WearcapError
from wearcap.export.files import load_exported
from wearcap.reading import read
from wearcap.recording.store import dataset_folder
from wearcap.runtime.system import CaptureInput, System


def main(arguments: list[str]) -> None:
    """Capture with an exported model until interrupted; prints the report as JSON."""
    parser = argparse.ArgumentParser(prog="python -m wearcap.apps.live", description=main.__doc__)
    parser.add_argument("model", type=Path, help="exported .onnx or .pt2 file, with the files written beside it")
    parser.add_argument("--source", nargs="+", default=[], metavar="URL", help="such as vmc://:39540")
    parser.add_argument("--recording", help="a recording to replay instead, with its objects")
    parser.add_argument("--to", nargs="+", default=[], metavar="URL", help="such as vmc://127.0.0.1:39539")
    parser.add_argument("--record", type=Path, help="folder in which motion.npz and motion.bvh grow")
    parser.add_argument("--height", type=float, help="of the wearer (m)")
    parser.add_argument("--speed", type=float, default=1.0, help="of a replay; inf: as fast as it goes")
    parser.add_argument("--seconds", type=float, default=math.inf, help="when to stop")
    parser.add_argument("--trust", action="store_true", help="open a .pt2 file from elsewhere, which can run code")
    options = parser.parse_args(arguments)
    if not options.source and options.recording is None:
        parser.error("give --source or --recording")
    with trusting(options.trust):
        system = load_exported(options.model)
    if not isinstance(system, System):
        raise WearcapError("a model that captures no motion", options.model, "one of hmd2, mocap_every or echo")
    texts, place = [*options.source], None
    if options.recording is not None:
        place = CaptureInput.in_dataset(read(options.recording), dataset_folder(options.recording))
        texts.append("replay")
    sources, setup = sources_of(texts, "127.0.0.1", system, place, options.speed)
    hands = "grip" if place is None else "joint"  # a recording has the wrists themselves
    known = Known(setup if options.height is None else None, options.height, hands)
    sinks = [sink_of(text, "127.0.0.1", options.speed <= 1) for text in options.to]
    capture = LiveCapture(system, sources, sinks, known=known, source=place, record=options.record)
    print(report_text(capture.run(options.seconds)), end="")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except WearcapError as error:
        sys.exit(f"error: {error}")
