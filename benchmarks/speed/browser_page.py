"""Frames per second of the browser's page, in headless Chromium, where the processor draws, while it plays its sample.

    python -m benchmarks.speed.browser_page FOLDER [--seconds 10] [--size 1200x675]

FOLDER is what `wearcap export format=web` wrote. Prints one JSON line: frames per second, milliseconds of a frame until all is handed to the driver, of a
window of the network (median), how many times real time the capture took, and the machine's load.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[2] / "tests")]

from wearcap_browser import chromium  # noqa: E402
from web_page import served  # noqa: E402

TIMED = """(() => {
    const own = wearcap.scene.draw.bind(wearcap.scene);
    const replay = wearcap.scene.renderer.render.bind(wearcap.scene.renderer);
    wearcap.timed = {frames: 0, own: 0, since: performance.now()};
    wearcap.scene.draw = () => { wearcap.timed.frames++; own(); };
    wearcap.scene.renderer.render = (...all) => {
        const start = performance.now();
        replay(...all);
        wearcap.timed.own += performance.now() - start;
    };
})()"""


def measured(folder: Path, seconds: float, size: tuple[int, int]) -> dict:
    """What a page does in some seconds after its sample is captured."""
    with (
        served(folder) as (url, _, _),
        tempfile.TemporaryDirectory() as profile,
        chromium(Path(profile), url, size) as browser,
    ):
        done = "globalThis.wearcap?.motion?.end >= wearcap.clock.end - 0.5 && wearcap.took"
        took = browser.poll(lambda: browser.evaluate(done), 300)
        time.sleep(4)  # the page finds out how much it can draw
        browser.evaluate(TIMED)
        time.sleep(seconds)
        found = browser.evaluate(
            "({...wearcap.timed, until: performance.now(), ratio: wearcap.scene.ratio, spent: wearcap.spent,"
            " length: wearcap.clock.end - wearcap.clock.start})"
        )
    return {
        "name": "web_page_fps",
        "value": round(1000 * found["frames"] / (found["until"] - found["since"]), 1),
        "draw_calls_ms": round(found["own"] / max(found["frames"], 1), 1),
        "window_ms": round(found["spent"], 1),
        "real_time": round(1000 * found["length"] / took, 1),
        "pixel_ratio": round(found["ratio"], 2),
        "load": round(os.getloadavg()[0], 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--size", default="1200x675")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    print(json.dumps(measured(options.folder, options.seconds, (width, height))), flush=True)


if __name__ == "__main__":
    main()
