"""`wearcap view`: a recording and motions captured from it, in the browser."""

import argparse
import logging

from wearcap.errors import WearcapError

HELP = "show a recording in the browser: wearcap view DATASET/NAME [--motion motion.npz …]"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="wearcap view", description="Show a recording in the browser.")
    parser.add_argument("recording", help="DATASET/NAME or a recording's .safetensors file")
    parser.add_argument(
        "--motion",
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="captured motions (.npz that `wearcap capture` wrote) to show with it; several stand side by side",
    )
    parser.add_argument("--port", type=int, default=8080, help="port of the page (default 8080, else the next free)")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve on (default: this machine only)")
    parser.add_argument("--environment", help="objects to show (default: what the recording names)")
    options = parser.parse_args(arguments)
    if not 0 < options.port < 65536:
        raise WearcapError(f"port {options.port}", expected="1 to 65535")

    from wearcap.cli.motions import read_motions
    from wearcap.recording.store import dataset_folder, load_recording
    from wearcap.runtime.system import CaptureInput
    from wearcap.viewer.page import Page

    # Browsers open connections in advance and drop them; the server's log of that is of no use to a user.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    recording = load_recording(options.recording)
    page = Page(
        recording,
        read_motions(options.motion),
        folder=dataset_folder(options.recording),
        host=options.host,
        port=options.port,
        environment=CaptureInput(recording, dataset_folder(options.recording)).objects(options.environment),
    )
    print(f"{recording.name}: open {page.url} (Ctrl+C ends; space plays, J and L jump by a second)")
    try:
        page.run()
    finally:
        page.stop()
