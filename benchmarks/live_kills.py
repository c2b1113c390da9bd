"""`wearcap live record=DIR` killed at random moments: every file must open, and lack at most a second.

    python benchmarks/live_kills.py [--kills 50] [--seed 0]

A process records ten frames of a moving person ten times a second and is killed (SIGKILL) after 0.3 to 15 s; the recording's
pace is that of a capture. Prints one JSON line: kills, files opened, and the longest motion that was lost (s). Leaves with 1
where a file does not open or more than a second is lost.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from wearcap.io.formats.bvh import read_bvh_content
from wearcap.io.formats.motion_npz import read_motion
from wearcap.live.sinks.files import join_sections

TESTS = Path(__file__).resolve().parents[1] / "tests"
RECORD = """
import sys, time
sys.path[:0] = [sys.argv[2]]
from dataclasses import replace
from pathlib import Path
import torch
from wearcap.live.sink import SinkThread
from wearcap.live.sinks.files import FilesSink
from wearcap_testing import swaying_motion
thread, motion = SinkThread(FilesSink(Path(sys.argv[1]))), swaying_motion(6, 0)
torch.set_num_threads(1)
thread.start()
thread.begin("", motion.skeleton, 60.0)
begin = time.monotonic()
for k in range(1000):
    thread.take("", replace(motion, timestamps=motion.timestamps + k / 10))
    print(k, flush=True)
    time.sleep(max(0.0, begin + (k + 1) / 10 - time.monotonic()))
"""


def killed(folder: Path, after_s: float) -> tuple[int, float]:
    """(files opened, motion lost in s) of a recording that is killed so long after its first frames."""
    command = [sys.executable, "-c", RECORD, str(folder), str(TESTS)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(after_s)
    os.kill(process.pid, signal.SIGKILL)
    sent_s = (1 + len(process.stdout.read().split())) / 10
    process.wait()
    opened, wearer = 0, folder / "wearer"
    for path in wearer.glob("motion-*.npz"):
        read_motion(path)
        opened += 1
    for path in wearer.glob("motion-*.bvh"):
        read_bvh_content(path)
        opened += 1
    kept_s = join_sections(wearer).timestamps[-1].item() + 1 / 60 if opened else 0.0
    return opened, sent_s - kept_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    draw, opened, lost = random.Random(options.seed), 0, []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.kills):
            files, seconds = killed(Path(folder) / str(number), draw.uniform(0.3, 15.0))
            opened += files
            lost.append(seconds)
    row = {"name": "live_kills", "kills": options.kills, "files": opened, "longest_lost_s": round(max(lost), 2)}
    print(json.dumps(row))
    sys.exit(max(lost) > 1.0)


if __name__ == "__main__":
    main()
