"""A motion in other world axes is the same motion."""

import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion


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
