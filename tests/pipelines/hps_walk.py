"""A small HPS recording with planted errors: half a minute round a circle on a scanned floor; no picture is rendered."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from walking_person import walk
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.recording import CameraStream, ContactTrack, ImuStream, Localization, Motion, Recording, RecordingStore
from wearcap.sensors.imu import synthesize_imu

LEVEL = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MOUNT = Rigid(LEVEL, torch.tensor([0.09, 0.0, 0.09]))
CLAPS_S = (1.31, 1.93, 27.42)


def floor_points() -> np.ndarray:
    """10 x 10 m, 2.5 cm apart, at the height of the walker's soles."""
    grid = np.arange(-5.0, 5.0, 0.025)
    return np.stack(np.meshgrid(grid, grid, [0.012], indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def drifting(truth: Motion, contact: torch.Tensor) -> Motion:
    """As a suit sees it: its own origin and heading, which drift by 2 cm and a fifth of a degree a second."""
    seconds = truth.timestamps - truth.timestamps[0]
    turn = rotation.about_axis("z", (0.8 + np.deg2rad(0.2) * seconds).float())
    R = truth.R_parent_joint.clone()
    R[:, 0] = turn @ R[:, 0]
    steps = (turn[1:] @ truth.t_world_root.diff(dim=0)[..., None])[..., 0]
    first = torch.tensor([[4.0, -2.0, truth.t_world_root[0, 2].item()]])
    t = torch.cat([first, first + steps.cumsum(0)]) + 0.02 * seconds.float()[:, None] * torch.tensor([0.6, 0.8, 0.0])
    return replace(truth, R_parent_joint=R, t_world_root=t, contact_prob=contact.float())


def localized(truth: Motion, noise_m: float = 0.03, seed: int = 0) -> Localization:
    """Where the head carries the camera, at the motion's frames."""
    T_world_cam = truth.joint("head") @ MOUNT
    random = torch.Generator().manual_seed(seed)
    t = T_world_cam.t + noise_m * torch.randn(len(truth), 3, generator=random)
    return Localization(truth.timestamps, T_world_cam.R, t, torch.ones(len(truth)))


def clapping_wrists(motion: Motion, claps_s: tuple[float, ...]) -> dict[str, ImuStream]:
    """Both wrists' sensors; the hands push each other apart at each clap."""
    streams = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        stream = synthesize_imu(motion, f"{side}_wrist", n=1)
        times = stream.timestamps[:, None] - torch.tensor(claps_s, dtype=torch.float64)
        push = 40 * torch.exp(-0.5 * (times / 0.011) ** 2).sum(1).float()
        assert stream.acc_world is not None
        shock = push[:, None] * torch.tensor([0.0, sign, 0.0])
        streams[f"{side}_wrist"] = replace(stream, acc_world=stream.acc_world + shock)
    return streams


def hps_recording(name: str = "walk", seconds: float = 30.0, camera_lead_s: float | None = None) -> Recording:
    """Suit at 60 Hz, camera localised at 30 Hz; `camera_lead_s`: by how much its clock leads, then with claps."""
    time = torch.arange(int(60 * seconds), dtype=torch.float64) / 60
    truth, contact = walk(time)
    found = localized(_every_second(truth))
    shift = camera_lead_s or 0.0
    found = replace(found, timestamps=found.timestamps + shift)
    camera = CameraStream(found.timestamps, Camera.pinhole(64, 48, 60.0), MOUNT.R, MOUNT.t)
    return Recording(
        name,
        suit=drifting(truth, contact),
        camera=camera,
        localization=found,
        scene="scene/pointcloud.ply",
        imu={} if camera_lead_s is None else clapping_wrists(truth, CLAPS_S),
        motion=truth,
        contacts=ContactTrack(time, FOOT_PATCHES, contact),
        skeleton=truth.skeleton,
        subject="someone",
        location="floor",
        license="MIT",
    )


def _every_second(motion: Motion) -> Motion:
    return replace(
        motion,
        timestamps=motion.timestamps[::2],
        R_parent_joint=motion.R_parent_joint[::2],
        t_world_root=motion.t_world_root[::2],
    )


def hps_dataset(root: Path, *recordings: Recording) -> RecordingStore:
    """Recordings of the test split with the scan that they name."""
    write_ply(Ply(floor_points(), None), root / "scene/pointcloud.ply")
    store = RecordingStore(root)
    for recording in recordings or (hps_recording(),):
        store.add(recording, split="test", config_hash="test")
    return store
