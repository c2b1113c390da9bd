"""The ground in pictures lies where the feet stand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.apps.viewer.ground import Ground
from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap_testing import swaying_motion

COLORS, RIM = np.ones((2, 3)), np.ones(3)


def climbing(rise_m: float, contacts: bool):
    """Someone who stands for half a second on every 0.4 m of a way, each `rise_m` above the one before, feet in contact."""
    motion = swaying_motion(600)
    still = replace(motion, R_parent_joint=torch.eye(3).expand_as(motion.R_parent_joint).contiguous())
    seconds = motion.timestamps - motion.timestamps[0]
    stair = torch.floor(seconds / 0.7)
    on_stair = seconds / 0.7 - stair < 0.7
    stair = stair + torch.where(on_stair, 0.0, (seconds / 0.7 - stair - 0.7) / 0.3)
    shift = torch.stack([0.4 * stair, 0 * stair, rise_m * stair], -1).float()
    prob = on_stair.float()[:, None].expand(-1, 4) if contacts else None
    return replace(still, t_world_root=motion.t_world_root[:1] + shift, contact_prob=prob), on_stair


@pytest.mark.parametrize("contacts", [True, False])
@pytest.mark.parametrize("rise_m", [0.17, -0.05, 0.0])
def test_feet_stand_on_the_ground_on_stairs_and_slopes(rise_m, contacts):
    motion, standing = climbing(rise_m, contacts)
    ground = Ground.of(motion)
    assert (len(ground.places) == 1) == (rise_m == 0)
    feet = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double().numpy()
    for frame in torch.nonzero(standing)[10::60, 0].tolist():
        time, center = motion.timestamps[frame].item(), motion.t_world_root[frame].double().numpy()
        sole = feet[frame, :, 2]
        assert np.abs(ground.heights(feet[frame, :, :2], time) - sole).max() < 0.04
        mesh = ground.mesh(center, time, COLORS, RIM)
        heights = ground.heights(mesh.vertices[:, :2].astype(float), time)
        assert np.abs(mesh.vertices[:, 2] - heights).max() < 1e-3


def test_a_motion_without_footfalls_stands_on_its_lowest_joint():
    motion = replace(swaying_motion(40), contact_prob=torch.zeros(40, 4))
    lowest = motion.T_world_joint.t[..., 2].min().item()
    assert Ground.of(motion).heights(np.zeros((1, 2)), 0.0)[0] == pytest.approx(lowest - 0.02, abs=0.02)
