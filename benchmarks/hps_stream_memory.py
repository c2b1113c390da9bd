"""HPS while it is recorded, for an hour: growth of the process' memory from the tenth minute to the sixtieth.

A simulated wearer walks through a flat; suit and localisation (5 cm, 1°) come in pieces of two seconds at 30 Hz and
are dropped when they have been pushed. value: peak memory (MiB) after the hour; baseline: after ten minutes;
ratio = value / baseline, to be at most `goal`.
"""

import resource
from dataclasses import replace

import numpy as np
import torch
from hydra.utils import instantiate

from wearcap.cli.conf import compose
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.recording import CameraStream, Localization, Motion, Recording
from wearcap.scene.scan import Scan
from wearcap.systems.hps.stream import HpsStream
from wearsim.recordings.simulate import SimulationConfig, simulate_recording
from wearsim.sensors.slam import R_DEVICE_CAM

MOUNT = Rigid(R_DEVICE_CAM, torch.tensor([0.09, 0.0, 0.09]))


def measure(minutes: int = 60, settle: int = 10) -> list[dict]:
    """A minute there and back, over and over: as long as one likes, and without a jump."""
    config = compose("capture", ["pipeline=hps", "recording=none"]).pipeline
    hps, rng = instantiate(config, _convert_="all"), np.random.default_rng(0)
    simulated = SimulationConfig(duration_s=60.0, fps=30.0, points=False, world="flat", activities=("walk", "stand"))
    recording = simulate_recording(simulated, "minute", "train", 3)
    assert recording.suit is not None
    assert recording.motion is not None
    camera = CameraStream(recording.suit.timestamps[:0], Camera.pinhole(960, 540, 60.0), MOUNT.R, MOUNT.t)
    about = replace(recording, motion=None, camera=camera)
    stream, early = HpsStream(hps, about, _floor(recording.motion, rng)), 0.0
    for minute in range(minutes):
        order = slice(None) if minute % 2 == 0 else slice(None, None, -1)
        for start in range(0, len(recording.suit), 60):
            stream.push(*_piece(recording, minute, order, slice(start, start + 60), rng))
        if minute + 1 == settle:
            early = _peak_mib()
    late = _peak_mib()
    return [
        {
            "name": "hps_stream_memory",
            "value": late,
            "unit": "MiB",
            "baseline": early,
            "ratio": late / early,
            "goal": 1.05,
        }
    ]


def _piece(
    recording: Recording, minute: int, order: slice, frames: slice, rng: np.random.Generator
) -> tuple[Motion, Localization]:
    suit, true = recording.suit, recording.motion
    assert suit is not None
    assert true is not None
    number = torch.arange(len(suit)).numpy()[order][frames].copy()
    times = 60.0 * minute + torch.arange(len(suit), dtype=torch.float64)[frames] / 30
    T_world_cam = Rigid(true.joint("head").R[number], true.joint("head").t[number]) @ MOUNT
    noise = torch.from_numpy(rng.normal(0, 1, (2, len(number), 3))).float()
    assert suit.contact_prob is not None
    piece = replace(
        suit,
        timestamps=times,
        R_parent_joint=suit.R_parent_joint[number],
        t_world_root=suit.t_world_root[number],
        contact_prob=suit.contact_prob[number],
    )
    found = Localization(
        times, rotation.exp(0.01 * noise[0]) @ T_world_cam.R, T_world_cam.t + 0.03 * noise[1], torch.ones(len(number))
    )
    return piece, found


def _floor(motion: Motion, rng: np.random.Generator) -> Scan:
    low, high = (
        getattr(motion.t_world_root, end)(0).values[:2].numpy() - side for end, side in (("min", 1.5), ("max", -1.5))
    )
    count = int(np.prod(high - low) / 0.015**2)
    points = np.column_stack([rng.uniform(low, high, (count, 2)), rng.normal(0, 0.002, count)])
    return Scan(points.astype(np.float32))


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
