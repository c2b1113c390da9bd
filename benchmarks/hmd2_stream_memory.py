"""HMD² while it is recorded, for an hour: growth of the process' memory from the tenth minute to the sixtieth.

A small network (one layer, one step, h = 60) follows a walk there and back; points come all the time and are
forgotten as by `Memory`. value: peak memory (MiB) after the hour; baseline: after ten minutes; ratio = value /
baseline, to be at most `goal`.
"""

import resource

import torch
from online import Walk

from wearcap.body.skeleton import xsens23
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.runtime.wearer import Wearer
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2, DiffusionModel, Overlap, Sampling
from wearcap.systems.hmd2.places import Memory
from wearcap.systems.hmd2.stream import HMD2Session


def measure(minutes: int = 60, settle: int = 10, max_points: int = 100_000) -> list[dict]:
    torch.manual_seed(0)
    features = HeadFeatures(contacts=True, body=True)
    net = MotionDenoiser(
        features.motion_size,
        features.condition_size,
        240,
        32,
        1,
        2,
        64,
        frames_per_token=4,
        points_size=VoxelAutoencoder().size,
        image_size=8,
    )
    model = DiffusionModel(net, features, CosineSchedule(), xsens23(), 60.0, VoxelAutoencoder(), "any")
    pipeline = HMD2(model, Sampling(steps=1), Overlap(stride=60, lookahead=0))
    session = HMD2Session(pipeline, [Wearer(xsens23())], [0], Memory(max_points=max_points))
    walk, early, predicted = Walk(pipeline, new_points=10, forever=True), 0.0, 0
    for second in range(60 * minutes):
        session.push([[walk.moment(60 * second + i) for i in range(60)]])
        motion = session.poses()[0]
        predicted += 0 if motion is None else len(motion)
        if second + 1 == 60 * settle:
            early = _peak_mib()
    assert predicted == 3600 * minutes
    late = _peak_mib()
    return [
        {
            "name": "hmd2_stream_memory",
            "value": late,
            "unit": "MiB",
            "baseline": early,
            "ratio": late / early,
            "goal": 1.05,
        }
    ]


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
