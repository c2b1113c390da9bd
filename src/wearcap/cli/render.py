"""`wearcap render`: a recording as a contact sheet or a video, on a machine without a screen."""

from pathlib import Path

from wearcap.cli.stated import stated
from wearcap.cli.verbs import Arguments
from wearcap.cli.view import add_recording, read_motions
from wearcap.errors import WearcapError


def main(arguments: list[str]) -> None:
    parser = Arguments(prog="wearcap render", description="Draw a recording to a PNG or an MP4.")
    add_recording(parser, "draw with it")
    parser.add_argument("--out", type=Path, help=".png for a contact sheet, .mp4 for a video (default: NAME.png)")
    parser.add_argument("--start", type=float, default=0.0, help="from this second of the recording on")
    parser.add_argument("--stop", type=float, help="up to this second")
    parser.add_argument("--frames", type=int, default=12, help="pictures in a contact sheet (default 12)")
    parser.add_argument("--video-fps", type=float, default=30.0, help="frame rate of a video (default 30)")
    parser.add_argument("--size", default="", help="WIDTHxHEIGHT of a panel in pixels, such as 480x400")
    parser.add_argument("--sticks", action="store_true", help="bones instead of a body surface")
    parser.add_argument("--environment", help="objects to draw (default: what the recording names)")
    options = parser.parse_args(arguments)

    from wearcap.apps.viewer.picture import contact_sheet, draw_head_path, save_png, shared_frames, write_video
    from wearcap.apps.viewer.shown import with_objects
    from wearcap.body.anny_body import anny_body
    from wearcap.reading import read
    from wearcap.recording.store import dataset_folder
    from wearcap.runtime.system import CaptureInput

    recording = read(options.recording, stated(vars(options)))
    out = options.out or Path(f"{recording.name}.png")
    if out.suffix not in (".png", ".mp4"):
        what = f"cannot draw a {out.suffix or 'file without an ending'}"
        raise WearcapError(what, where=out, expected=".png or .mp4")
    environment = CaptureInput(recording, dataset_folder(options.recording)).objects(options.environment)
    truth = with_objects(recording, environment)
    shown = {"truth": truth, "suit": recording.suit} if truth is None else {"truth": truth}
    motions = {label: motion for label, motion in shown.items() if motion} | read_motions(options.motion)
    motions = {label: motion.between(options.start, options.stop) for label, motion in motions.items()}
    size = {"size": _size(options.size)} if options.size else {}
    if not motions:
        if out.suffix == ".mp4":
            raise WearcapError("no motion to film", where=recording.name, expected="a .png of its head path")
        save_png(out, draw_head_path(recording, **size))
    else:
        skeleton = next(iter(motions.values())).skeleton
        body = None if options.sticks else anny_body(skeleton, recording.shape or None)
        shown = size | {"body": body, "environment": environment}
        if out.suffix == ".mp4":
            write_video(out, motions, fps=options.video_fps, **shown)
        else:
            save_png(out, contact_sheet(motions, shared_frames(motions, options.frames), **shown))
    print(f"wrote {out}")


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError as error:
        raise WearcapError(f"size {text!r}", expected="WIDTHxHEIGHT, such as 480x400") from error
    if not (16 <= width <= 8192 and 16 <= height <= 8192):
        raise WearcapError(f"size {text!r}", expected="16 to 8192 pixels each way")
    return width, height
