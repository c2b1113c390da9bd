"""Soles and heads that are captured tilted are found from how people stand, and turned level without moving a joint."""

from dataclasses import replace

import pytest
import torch

from data_prep.shared.mocap import About, CleaningLimits, MocapSettings, foot_patches, mocap_recording
from wearcap.body.kinematics import local_rotations, site_positions
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.geometry import rotation
from wearcap.prepare.levels import Levels, face_in, levels_in, with_levels
from wearcap.recording import Motion

SETTINGS = MocapSettings(60.0, (0.09, 0.0, 0.09), CleaningLimits(8.0, 15.0, 0.5, 0.06, 0.12))
TILT = 0.2


def standing_on_tilted_frames() -> Motion:
    """Someone who stands and squats a little; the frames of ankles and toes are pitched by `TILT`, no joint is moved."""
    skeleton, frames = xsens23(), 240
    squat = 0.4 * torch.sin(torch.linspace(0, 12, frames)).clamp_min(0)
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    pitch = rotation.about_axis("y", torch.tensor(TILT))
    offsets = skeleton.t_parent_joint.clone()
    for side in ("left", "right"):
        hip, knee, ankle, toe = skeleton.indices(*(f"{side}_{name}" for name in ("hip", "knee", "ankle", "toe")))
        R[:, hip], R[:, knee] = rotation.about_axis("y", -squat), rotation.about_axis("y", 2 * squat)
        R[:, ankle] = rotation.about_axis("y", -squat) @ pitch
        offsets[toe] = pitch.T @ offsets[toe]
    times = torch.arange(frames, dtype=torch.float64) / 60
    legs = 0.85 * (1 - squat.cos())
    t = torch.stack([0 * legs, 0 * legs, skeleton.root_height - legs], -1)
    return Motion(times, replace(skeleton, t_parent_joint=offsets), R, t)


def test_tilted_soles_are_found_and_levelled_without_moving_a_joint():
    motion = standing_on_tilted_frames()
    levels = levels_in([motion])
    assert set(levels.R_joint_sole) == {f"{side}_{name}" for side in ("left", "right") for name in ("ankle", "toe")}
    for tilt in levels.R_joint_sole.values():
        assert torch.rad2deg(rotation.geodesic(tilt, rotation.about_axis("y", torch.tensor(-TILT)))) < 0.5
    level = with_levels(motion, levels)
    torch.testing.assert_close(level.T_world_joint.t, motion.T_world_joint.t, atol=1e-5, rtol=0)
    heights = site_positions(level.skeleton, level.T_world_joint, FOOT_PATCHES)[..., 2]
    still = motion.timestamps < 0.05
    assert heights[still].std(1).max() < 0.003
    tilted = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)[..., 2]
    assert tilted[still].std(1).min() > 0.012
    recording = mocap_recording(level, About("a", "1", "test", "none"), SETTINGS)
    assert recording.motion is not None
    standing = foot_patches(recording.motion)[0][..., 2].median(0).values
    assert standing.abs().max() < 0.004


def test_a_foot_that_never_stands_keeps_its_frame():
    motion = standing_on_tilted_frames()
    t = motion.t_world_root + torch.stack([3 * motion.timestamps.float(), *[torch.zeros(len(motion))] * 2], -1)
    assert levels_in([replace(motion, t_world_root=t)]).R_joint_sole == {}


@pytest.mark.parametrize(("pitch", "trusted", "corrected"), [(0.6, True, True), (0.2, True, False), (0.2, False, True)])
def test_a_trusted_head_is_corrected_only_when_it_is_clearly_off(pitch, trusted, corrected):
    motion = standing_on_tilted_frames()
    R = motion.T_world_joint.R.clone()
    R[:, motion.skeleton.index("head")] = rotation.about_axis("y", torch.tensor(pitch))
    motion = replace(motion, R_parent_joint=local_rotations(motion.skeleton, R))
    levels = replace(levels_in([motion]), R_head_face=face_in([motion], trusted))
    assert (levels.R_head_face is not None) == corrected
    face = with_levels(motion, levels).joint("head").R[0, 2, 0]
    assert (abs(torch.rad2deg(-face.asin()).item() - 7) < 0.5) == corrected


def test_no_levels_change_no_rotation():
    motion = standing_on_tilted_frames()
    assert torch.equal(with_levels(motion, Levels(None, {})).R_parent_joint, motion.R_parent_joint)
