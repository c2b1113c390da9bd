"""`wearcap annotate`: mark in the browser when each hand holds something, beside the video, and export the labels."""

import argparse
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from wearcap.errors import WearcapError

if TYPE_CHECKING:
    from wearcap.viewer.annotate import Desk

HELP = "mark hand contacts in the browser: wearcap annotate DATASET/NAME [--video FILE]"
_DESCRIPTION = """Mark in the browser when each hand holds something: video beside the 3D pose, a click on a hand
starts and ends a contact. Labels are saved as you work, to OUTPUT/NAME.contacts.json, and taken up again next time.
`wearcap annotate export --help` writes them as H-contact's JSON."""
_RECORDING = "DATASET/NAME, a recording's .safetensors file, or DATASET for all of its recordings"
_OUTPUT = "folder of the labels (default: outputs/annotate/DATASET's name)"


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["export"]:
        return _export(arguments[1:])
    parser = argparse.ArgumentParser(prog="wearcap annotate", description=_DESCRIPTION)
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
    parser.add_argument("--port", type=int, default=8090, help="port of the page (default 8090, else the next free)")
    parser.add_argument("--no-browser", action="store_true", help="print the address, open nothing")
    options = parser.parse_args(arguments)
    if not 0 < options.port < 65536:
        raise WearcapError(f"port {options.port}", expected="1 to 65535")
    if options.video_start is not None and options.video is None:
        raise WearcapError("--video-start without a video", expected="--video FILE with it")
    return _annotate(options)


def _annotate(options: argparse.Namespace) -> None:
    from wearcap.io.formats.motion_npz import read_motion
    from wearcap.viewer.annotate import Desk
    from wearcap.viewer.annotate_server import AnnotationServer

    motion = read_motion(options.motion) if options.motion else None
    desk = Desk.of(options.recording, options.output, motion, options.video, options.video_start)
    if len(desk.names) == 1:
        desk.file(0).read()  # unreadable labels raise here, before a page opens
    if options.start:
        _start_from(desk, options.start)
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


def _start_from(desk: "Desk", source: str) -> None:
    """Write labels to start from; labels that are there already are never replaced."""
    from wearcap.io.formats.contact_labels import annotation_of
    from wearcap.viewer.annotation_file import starting_labels

    if len(desk.names) > 1 and source != "recording":
        raise WearcapError(f"labels from {source} for {len(desk.names)} recordings", expected="one recording")
    for index in range(len(desk.names)):
        file = desk.file(index)
        if file.path.exists():
            raise WearcapError(
                "there are labels already, which are never replaced",
                where=file.path,
                fix="Leave out --from to go on with them, or give another --output.",
            )
        labels = starting_labels(source, desk.recording(index), file.clock)
        file.save(annotation_of(labels, file.clock), "")


def _export(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="wearcap annotate export",
        description="Write annotated labels as H-contact's JSON: "
        '{"contacts": {"left_hand": [[start, end], …], "right_hand": […]}} in seconds on the recording\'s clock; '
        "an end before its start means: until the recording ends.",
    )
    parser.add_argument("recording", help=_RECORDING)
    parser.add_argument("--output", type=Path, help=_OUTPUT)
    parser.add_argument("--to", type=Path, help="file, or folder for several recordings (default: NAME.json here)")
    options = parser.parse_args(arguments)

    from wearcap.files import write_text
    from wearcap.io.formats.contact_labels import hcontact_text
    from wearcap.viewer.annotate import Desk

    desk = Desk.of(options.recording, options.output)
    several = len(desk.names) > 1
    annotated = [k for k, name in enumerate(desk.names) if desk.path(name).is_file()]
    if not annotated:
        raise WearcapError(
            "no labels to export",
            where=desk.output,
            expected=f"{desk.path(desk.names[0]).name}",
            fix=f"Make them with `wearcap annotate {options.recording}`.",
        )
    for index in annotated:
        labels, _ = desk.file(index).read()
        target = Path(f"{desk.names[index]}.json")
        if options.to:
            target = options.to / target if several or options.to.is_dir() else options.to
        if target.resolve() == desk.path(desk.names[index]).resolve():
            raise WearcapError("the export would replace the labels it comes from", where=target)
        write_text(target, hcontact_text(labels, desk.file(index).clock))
        print(f"wrote {target}: {len(labels['left'])} contacts of the left hand, {len(labels['right'])} of the right")
