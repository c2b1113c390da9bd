"""Small deterministic recordings for the tests of the preparation engine (imported by its workers)."""

import os
import re
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from data_prep.shared.engine import Task, prepare
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry.rotation import exp
from wearcap.recording import Motion, Recording


def recording(name: str, seed: int, frames: int = 120, fps: float = 60.0) -> Recording:
    generator = torch.Generator().manual_seed(seed)
    skeleton = xsens23()
    R = exp(0.3 * torch.randn(frames, len(skeleton), 3, generator=generator))
    times = torch.arange(frames, dtype=torch.float64) / fps if fps else torch.zeros(frames, dtype=torch.float64)
    t_root = torch.randn(frames, 3, generator=generator)
    return Recording(name, motion=Motion(times, skeleton, R, t_root), skeleton=skeleton, subject=f"s{seed}")


@dataclass(frozen=True)
class Make:
    name: str
    seed: int
    fault: str = ""
    seconds: float = 0.0

    def __call__(self) -> Recording:
        time.sleep(self.seconds)
        if self.fault == "refused":
            raise WearcapError("cut short", where=f"{self.name}.amc")
        if self.fault == "bug":
            raise ZeroDivisionError("division by zero")
        if self.fault == "stuck":  # in native code that holds Python's lock, for hours
            print("stuck", flush=True)
            re.match(r"(a+)+$", "a" * 40 + "b")
        if self.fault == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        made = recording(
            self.name, self.seed, 3 if self.fault == "short" else 120, 0.0 if self.fault == "still" else 60.0
        )
        if self.fault == "nan":
            made.motion.t_world_root[7, 1] = float("nan")
        if self.fault == "sheared":
            made.motion.R_parent_joint[5, 2] *= 1.1
        return made


def tasks(count: int, seconds: float = 0.0, **faults: str) -> list[Task]:
    names = [f"r{index:02}" for index in range(count)]
    return [
        Task(name, Make(name, index, faults.get(name, ""), seconds), "train", content_hash(index))
        for index, name in enumerate(names)
    ]


def run(output: str, count: int, seconds: float = 0.0, jobs: int = 1, backend: str = "loky") -> None:
    prepare(tasks(count, seconds), Path(output), jobs=jobs, backend=backend)


if __name__ == "__main__":  # python prepare_tasks.py OUTPUT COUNT SECONDS [JOBS [BACKEND]]
    run(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(*sys.argv[4:5] or [1]), *sys.argv[5:])
