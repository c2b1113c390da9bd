"""`wearcap annotate`: mark in the browser when each hand holds something, beside the video, and export the labels."""

import webbrowser
from pathlib import Path

from wearcap.cli.main import add_page
from wearcap.cli.verbs import Arguments
from wearcap.errors import WearcapError

_DESCRIPTION = """Mark in the browser when each hand holds something: video beside the 3D pose, a click on a hand
starts and ends a contact. Labels are saved as you work, to OUTPUT/NAME.contacts.json, and taken up again next time.
`wearcap annotate export --help` writes them as H-contact's JSON."""
_RECORDING = "DATASET/NAME, a recording's .safetensors file, or DATASET for all of its recordings"
_OUTPUT = "folder of the labels (default: outputs/annotate/DATASET's name)"


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["export"]:
        return _export(arguments[1:])
    parser = Arguments(prog="wearcap annotate", description=_DESCRIPTION)
    parser.add_argument("recording", help=_RECORDING)
    parser.add_argument("--output", type=Path, help=_OUTPUT)
    parser.add_argument("--video", type=Path, help="video to show (default: that of the recording's camera)")
    parser.add_argument(
        "--video-start",
        type=float,
        metavar="SECONDS",
        help="time of the recording at which the video begins (default: its first frame)",
    )
    parser.add_argument("--motion", help="captured motion (.npz that `wearcap capture` wrote) to look at")
    parser.add_argument(
        "--from",
        dest="start",
        metavar="FILE",
        help="labels to start from, where there are none yet: contacts of a captured motion (.npz), a label file "
        "(.json), or `recording` for the recording's own",
    )
    add_page(parser, 8090)
    parser.add_argument("--no-browser", action="store_true", help="print the address, open nothing")
    options = parser.parse_args(arguments)
    if options.video_start is not None and options.video is None:
        raise WearcapError("--video-start without a video", expected="--video FILE with it")

    from wearcap.apps.annotate.server import AnnotationServer
    from wearcap.apps.annotate.takes import Desk
    from wearcap.io.formats.motion_npz import read_motion

    motion = read_motion(options.motion) if options.motion else None
    desk = Desk(options.recording, options.output, motion, options.video, options.video_start)
    if len(desk.names) == 1:
        desk.file(0).read()  # unreadable labels raise here, before a page opens
    if options.start:
        desk.start_from(options.start)
    server = AnnotationServer(desk, options.port)
    print(
        f"{desk.names[0] if len(desk.names) == 1 else f'{len(desk.names)} recordings'}: open {server.url} "
        f"(Ctrl+C ends); labels go to {desk.output}"
    )
    if not options.no_browser:
        webbrowser.open(server.url)
    try:
        server.wait()
    finally:
        server.stop()


def _export(arguments: list[str]) -> None:
    parser = Arguments(
        prog="wearcap annotate export",
        description="Write annotated labels as H-contact's JSON: "
        '{"contacts": {"left_hand": [[start, end], …], "right_hand": […]}} in seconds on the recording\'s clock; '
        "an end before its start means: until the recording ends.",
    )
    parser.add_argument("recording", help=_RECORDING)
    parser.add_argument("--output", type=Path, help=_OUTPUT)
    parser.add_argument("--to", type=Path, help="file, or folder for several recordings (default: NAME.json here)")
    options = parser.parse_args(arguments)

    from wearcap.apps.annotate.takes import Desk

    for target, left, right in Desk(options.recording, options.output).export(options.to):
        print(f"wrote {target}: {left} contacts of the left hand, {right} of the right")
