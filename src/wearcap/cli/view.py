"""`wearcap view`: a recording and motions captured from it, in the browser."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wearcap.cli.main import add_page
from wearcap.cli.stated import add_conventions, stated
from wearcap.cli.verbs import Arguments
from wearcap.errors import WearcapError

if TYPE_CHECKING:
    from wearcap.recording.motion import Motion

RESERVED = ("truth", "over", "beside")
"""Names that the page and the pictures use for other purposes."""


def read_motions(paths: Sequence[str]) -> "dict[str, Motion]":
    """Motions by name: a single file is "capture"; several have their file names, prefixed by folders if these agree.

    Raises WearcapError for a file that is given twice, and as `read_motion` does.
    """
    from wearcap.io.formats.motion_npz import read_motion

    if len(paths) == 1:
        return {"capture": read_motion(paths[0])}
    files = [Path(path).resolve() for path in paths]
    labels = [file.stem for file in files]
    if len(set(labels)) < len(labels) or set(labels) & set(RESERVED):
        labels = [f"{file.parent.name} {file.stem}" for file in files]
    if len(set(labels)) < len(labels):
        labels = [str(file).replace("/", " ").strip() for file in files]
    if len(set(labels)) < len(labels):
        raise WearcapError("a motion is given twice", where=", ".join(paths), expected="each file once")
    return {label: read_motion(file) for label, file in zip(labels, files, strict=True)}


def add_recording(parser: Arguments, purpose: str) -> None:
    """Add the recording and the option `--motion FILE …`, whose files `read_motions` reads."""
    parser.add_argument("recording", help="DATASET/NAME, or any file or folder that holds a recording")
    text = f"captured motions (.npz that `wearcap capture` wrote) to {purpose}"
    add_conventions(parser)
    parser.add_argument("--motion", nargs="+", action="extend", default=[], metavar="FILE", help=text)


def main(arguments: list[str]) -> None:
    parser = Arguments(prog="wearcap view", description="Show a recording in the browser.")
    add_recording(parser, "show with it; several stand side by side")
    add_page(parser, 8080, host=True)
    parser.add_argument("--environment", help="objects to show (default: what the recording names)")
    options = parser.parse_args(arguments)

    from wearcap.apps.viewer.page import Page
    from wearcap.reading import read
    from wearcap.recording.store import dataset_folder
    from wearcap.runtime.system import CaptureInput

    recording, folder = read(options.recording, stated(vars(options))), dataset_folder(options.recording)
    captures = read_motions(options.motion)
    if recording.motion is None and recording.suit is not None:
        captures = {"suit": recording.suit} | captures
    environment = CaptureInput(recording, folder).objects(options.environment)
    page = Page(recording, captures, folder=folder, host=options.host, port=options.port, environment=environment)
    print(f"{recording.name}: open {page.url} (Ctrl+C ends; space plays, J and L jump by a second)")
    page.serve()
