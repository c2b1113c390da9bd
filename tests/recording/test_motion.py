"""A motion in other world axes is the same motion; the beginning of a recording."""

from dataclasses import replace

import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion
from wearcap.recording.motion import Interactions
from wearcap.recording.recording import ImuStream
from wearcap.recording.timing import first_seconds
from wearcap_testing import recording_of, swaying_motion


def test_a_moved_motion_takes_joints_and_objects_along():
    skeleton, frames = xsens23(), 5
    random = torch.Generator().manual_seed(0)
    R = rotation.exp(torch.randn(frames, len(skeleton) + 1, 3, generator=random))
    t, times = torch.randn(2, frames, 3, generator=random), torch.arange(frames).double()
    crate = Trajectory(times, R[:, -1], t[1])
    motion = Motion(times, skeleton, R[:, :-1], t[0], object_motion={"crate": crate})
    T_new_world = Rigid(rotation.exp(torch.randn(3, generator=random)), torch.randn(3, generator=random))
    moved = motion.moved(T_new_world)
    assert moved.object_motion is not None
    for found, old in (
        (moved.T_world_joint, motion.T_world_joint),
        (moved.object_motion["crate"].T_world_body, crate.T_world_body),
    ):
        wanted = T_new_world @ old
        assert torch.allclose(found.R, wanted.R, atol=1e-5)
        assert torch.allclose(found.t, wanted.t, atol=1e-5)
    assert torch.equal(motion.R_parent_joint, R[:, :-1]), "the old one stays as it was"


def test_the_first_seconds_of_a_recording_are_those_of_every_stream():
    whole = recording_of(swaying_motion(120), "r")
    assert whole.head is not None
    rows = [(0.1, 0.4, [True, False], "a", ""), (0.8, 1.5, [True, True], "b", ""), (1.2, 1.4, [False, True], "c", "")]
    track = Trajectory(whole.head.timestamps[::4], whole.head.R_world_device[::4], whole.head.t_world_device[::4])
    watch = ImuStream(whole.head.timestamps[::2], "left_wrist", acc_world=torch.zeros(60, 3))
    full = replace(whole, interactions=Interactions.of(rows), object_motion={"a": track}, imu={"left": watch})
    cut = first_seconds(full, 1.0)
    assert (len(cut.head.timestamps), len(cut.motion), len(cut.contacts.contact), len(cut.floor.height)) == (60,) * 4
    assert (len(cut.imu["left"].acc_world), len(cut.object_motion["a"])) == (30, 15)
    assert cut.head.R_head_device is whole.head.R_head_device
    assert torch.equal(cut.head.t_world_device, whole.head.t_world_device[:60])
    assert cut.interactions.rows == [rows[0], (0.8, 1.0, *rows[1][2:])]
    assert first_seconds(full, 9.0).motion.timestamps.equal(full.motion.timestamps)
