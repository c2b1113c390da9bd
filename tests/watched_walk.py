"""A walking person with two watches and a head device, and an estimator with drawn weights."""

import torch

from walking_person import SEAT, inertial, room, walk
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.models.layers import TransformerSize
from wearcap.recording import ContactTrack, FloorTrack, HeadStream, Recording
from wearcap.systems.mocap_every.features import WatchFeatures
from wearcap.systems.mocap_every.model import TwoStageEstimator
from wearcap.systems.mocap_every.pipeline import MocapEvery, Overlap, WatchModel

WINDOW, FPS = 16, 30.0
SIZE = TransformerSize(32, 1, 2, 32, 0.0)


def drawn_pipeline(multi_stage: bool = True, **settings) -> MocapEvery:
    """A small pipeline whose network has drawn weights."""
    torch.manual_seed(0)
    features = WatchFeatures("heading", body=True)
    net = TwoStageEstimator(features.size, features.motion_size, WINDOW, SIZE, 16, multi_stage, 2)
    how = {"stride": 4, "lookahead": 8, "mirror_average": True}
    overlap = Overlap(**{name: settings.pop(name, value) for name, value in how.items()})
    return MocapEvery(WatchModel(net.eval(), features, xsens23(), FPS), overlap, **settings)


def watched_walk(seconds: float = 4.0, watch_hz: float = 100.0) -> Recording:
    """A walk with watches that measure without errors, among points, on a floor whose height is known."""
    time = torch.arange(int(seconds * FPS), dtype=torch.float64) / FPS
    motion, contact = walk(time)
    T_world_device = motion.joint("head") @ SEAT
    imu = {joint: inertial(joint, seconds, watch_hz) for joint in ("left_wrist", "right_wrist")}
    return Recording(
        "walk",
        head=HeadStream(time, T_world_device.R, T_world_device.t, SEAT.R, SEAT.t),
        motion=motion,
        imu=imu,
        points=room(),
        contacts=ContactTrack(time, FOOT_PATCHES, contact),
        floor=FloorTrack(time, torch.zeros(len(time))),
        skeleton=motion.skeleton,
    )
