"""The simulated wearer's body obeys what bodies obey."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.geometry import rotation
from wearsim.people.actions import ACTIVITIES
from wearsim.people.wearer import simulate_motion
from wearsim.places.flat import build_flat

FPS = 60.0


def patches_of(motion):
    """Positions of `FOOT_PATCHES` in the world (m), time patch 3."""
    skeleton = motion.skeleton
    sites = [skeleton.sites[name] for name in FOOT_PATCHES]
    return torch.stack([motion.joint(s.joint) @ torch.tensor(s.t_joint_site) for s in sites], 1)


def below_floor(world, motion):
    """How far each patch is under the floor below it (m)."""
    patches = patches_of(motion).double().numpy()
    floor = world.floor_height(patches[..., :2], patches[..., 2])
    return torch.from_numpy(np.nan_to_num(floor - patches[..., 2], nan=-1.0))


def test_feet_in_contact_stand_still(everything):
    patches = patches_of(everything.motion)
    speed = (patches[1:, :, :2] - patches[:-1, :, :2]).norm(dim=-1) * FPS
    still = everything.contact[1:] & everything.contact[:-1]
    assert 0.35 < everything.contact.float().mean() < 0.95
    assert speed[still].mean() < 0.002
    assert speed[still].max() < 0.02
    assert speed[~still].mean() > 0.2, "what is not in contact moves"


def test_feet_stay_above_the_floor(stairs_flat, everything):
    below = below_floor(stairs_flat, everything.motion)
    assert below[everything.contact].max() < 0.005
    assert below.max() < 0.035, "no swing passes through a stair"
    assert (below > 0.005).float().mean() < 0.001
    assert below[everything.contact].min() > -0.02, "a patch in contact touches"


def test_knees_and_elbows_bend_one_way_within_limits(everything):
    motion = everything.motion
    for joint, axis in (("knee", (0.0, 1.0, 0.0)), ("elbow", None)):
        for side in ("left", "right"):
            R = motion.R_parent_joint[:, motion.skeleton.index(f"{side}_{joint}")].double()
            turn = rotation.log(R)
            assert turn.norm(dim=-1).rad2deg().max() < 151
            if axis is not None:
                assert (turn @ torch.tensor(axis, dtype=torch.float64)).min() > 0
                assert turn[:, [0, 2]].abs().max() < 1e-3, "a hinge"
            else:
                # The upper arm and the forearm: the bend's sign about the vertical axis of the T-pose.
                forearm = R[:, :, 1] * (1 if side == "left" else -1)
                assert (forearm[:, 0] > -0.02).all(), "the forearm folds forwards"


def test_hips_and_head_keep_to_their_range(everything):
    motion = everything.motion
    for name, limit in (("left_hip", 125), ("right_hip", 125), ("head", 80), ("l5", 40), ("t8", 40)):
        turn = rotation.log(motion.R_parent_joint[:, motion.skeleton.index(name)].double())
        assert turn.norm(dim=-1).rad2deg().max() < limit, name


def test_nothing_jumps(everything):
    motion = everything.motion
    position = motion.T_world_joint.t.double()
    acceleration = (position.diff(n=2, dim=0) * FPS**2).norm(dim=-1)
    for name, limit in (("pelvis", 25), ("head", 25), ("left_ankle", 160), ("left_knee", 300), ("left_wrist", 120)):
        assert acceleration[:, motion.skeleton.index(name)].max() < limit, name
    R = motion.R_parent_joint.double()
    rate = rotation.log(R[:-1].transpose(-1, -2) @ R[1:]).norm(dim=-1) * FPS
    assert rate.max() < 25


def test_the_head_is_where_a_standing_head_is(stairs_flat, everything):
    head = everything.motion.joint("head").t[:, 2] - everything.floor_height
    standing = everything.motion.skeleton.height_of("head")
    assert head.max() < standing + 0.12
    assert head.median() > 0.9 * standing
    assert everything.floor_height.max() > 2.0, "the way led up the stairs"


def test_labels_cover_the_time(everything):
    labels = everything.labels
    assert labels[0].start_s == 0
    assert labels[-1].stop_s >= everything.motion.timestamps[-1]
    for before, after in pairwise(labels):
        assert after.start_s == before.stop_s > before.start_s


def test_deterministic_for_a_generator(stairs_flat, person):
    a, b, c = (simulate_motion(stairs_flat, person, np.random.default_rng(seed), 8.0) for seed in (3, 3, 4))
    assert torch.equal(a.motion.R_parent_joint, b.motion.R_parent_joint)
    assert torch.equal(a.motion.t_world_root, b.motion.t_world_root)
    assert a.labels == b.labels
    assert not torch.equal(a.motion.t_world_root, c.motion.t_world_root)


@pytest.mark.parametrize("activity", sorted(ACTIVITIES))
def test_every_activity_finds_an_occasion_in_a_flat(activity, person):
    for seed in range(4):
        world = build_flat(np.random.default_rng(seed), "flat", stairs=False)
        simulated = simulate_motion(world, person, np.random.default_rng(seed), 12.0, 30.0, [activity])
        assert len(simulated.motion) == 360
        assert simulated.motion.T_world_joint.t.isfinite().all()
        assert below_floor(world, simulated.motion).max() < 0.005
        if activity in {label.name for label in simulated.labels}:
            return
    pytest.fail("no occasion in four flats")
