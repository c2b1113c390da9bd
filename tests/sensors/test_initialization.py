"""The start of the optimisation: planted headings and ways come back; outages and outliers are bridged."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from localized_walk import MOUNT, PERFECT, LocalizationNoise, localized, strolling_motion, turned

from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording.recording import Localization
from wearcap.sensors.initialization import (
    InitializationSettings,
    align_suit,
    body_camera,
    gravity_in_map,
    initialize,
    inliers,
    yaw_between,
)
from wearcap.sensors.path_fusion import DriftPrior
from wearsim.sensors.suit import SuitNoise, suit_motion

PAPER = InitializationSettings("tangent")


def drifting(motion, yaw):
    """The motion as measured by a suit whose heading runs ahead by `yaw` (rad, per frame)."""
    lead = rotation.about_axis("z", yaw.float())
    R = motion.R_parent_joint.clone()
    R[:, 0] = lead @ R[:, 0]
    step = motion.t_world_root.diff(dim=0, prepend=motion.t_world_root[:1])
    t = motion.t_world_root[:1] + (lead @ step[..., None])[..., 0].cumsum(0)
    return replace(motion, R_parent_joint=R, t_world_root=t)


def yaw_error_deg(found, truth):
    return yaw_between(found.R_parent_joint[:, 0], truth.R_parent_joint[:, 0])[0].rad2deg()


@pytest.mark.parametrize("settings", [PAPER, InitializationSettings()])
def test_a_perfect_suit_and_camera_are_left_alone(settings):
    motion = strolling_motion(60.0)
    start = initialize(motion, localized(motion, PERFECT), MOUNT.R, MOUNT.t, settings)
    assert start.yaw_correction.abs().max().rad2deg() < (2.0 if settings is PAPER else 0.05)
    assert (start.motion.t_world_root - motion.t_world_root).norm(dim=-1).max() < 0.015
    assert start.valid.float().mean() > 0.99


def test_the_tangent_takes_the_whole_angle_and_who_stands_keeps_the_last():
    """By eq. 4.13 as printed 60° would become sin 60° = 49.6°."""
    motion = strolling_motion(40.0)
    suit = turned(motion, math.radians(60))
    start = initialize(suit, localized(motion, PERFECT), MOUNT.R, MOUNT.t, PAPER)
    assert (start.yaw_correction.rad2deg() + 60).abs().max() < 2.0
    standing = (motion.timestamps > 15.5) & (motion.timestamps < 19.5)
    assert start.yaw_correction[standing].diff().abs().max() == 0.0
    late = (motion.timestamps > 15.5) & (motion.timestamps < 38)
    cut = suit.sliced(int(late.nonzero()[0]), int(late.nonzero()[-1]))
    first = initialize(cut, localized(motion, PERFECT), MOUNT.R, MOUNT.t, PAPER).yaw_correction
    moving = first.diff().nonzero()[0, 0]
    assert moving > 200, "four seconds of standing"
    assert (first[: moving + 1] == first[0]).all()


def test_a_drifting_heading_is_followed_also_while_standing():
    motion = strolling_motion(120.0)
    drift = torch.linspace(0.0, math.radians(20), len(motion))
    suit = drifting(motion, drift)
    found = localized(motion, LocalizationNoise())
    errors = {}
    for name, settings in (("fused", InitializationSettings()), ("tangent", PAPER)):
        start = initialize(suit, found, MOUNT.R, MOUNT.t, settings)
        errors[name] = yaw_error_deg(start.motion, motion)
    assert errors["fused"].abs().max() < 3.0
    assert errors["fused"].square().mean().sqrt() < 1.0
    assert errors["tangent"].square().mean().sqrt() > 2 * errors["fused"].square().mean().sqrt()


def test_the_bodys_camera_sits_at_the_camera():
    motion = strolling_motion(30.0)
    found = localized(motion, replace(PERFECT, position_m=0.05))
    start = initialize(drifting(motion, torch.full((len(motion),), 0.3)), found, MOUNT.R, MOUNT.t, PAPER)
    placed = body_camera(start.motion, MOUNT.t)[::2][: len(found.timestamps)]
    seen = inliers(found)
    assert seen.float().mean() > 0.6
    assert (placed - found.t_world_cam)[seen].norm(dim=-1).max() < 1e-4


def test_a_mount_that_is_not_the_nominal_shows_on_the_way():
    motion = strolling_motion(120.0)
    worn = Rigid(MOUNT.R @ rotation.exp(torch.tensor([0.0, 0.1, 0.0])), MOUNT.t)
    aligned, angle = align_suit(motion, localized(motion, LocalizationNoise(), mount=worn), MOUNT)
    assert angle.abs().rad2deg() > 4
    start = initialize(aligned, localized(motion, LocalizationNoise(), mount=worn), MOUNT.R, MOUNT.t)
    assert yaw_error_deg(start.motion, motion).square().mean().sqrt() < 1.0


def test_an_outage_is_bridged_by_the_suit():
    """Ten seconds without a camera on a winding path: the straight line is metres off, the suit centimetres."""
    motion = strolling_motion(60.0, pauses=False)
    standing = torch.zeros(len(motion), len(FOOT_PATCHES), dtype=torch.bool)
    suit = suit_motion(motion, standing, SuitNoise(), np.random.default_rng(0))
    found = localized(motion, LocalizationNoise(outages_s=((25.0, 35.0),)))
    lost = (motion.timestamps > 25.1) & (motion.timestamps < 34.9)
    error = {}
    for path in ("tangent", "fused"):
        start = initialize(suit, found, MOUNT.R, MOUNT.t, InitializationSettings(path))
        error[path] = (start.motion.t_world_root - motion.t_world_root)[lost].norm(dim=-1).mean()
        assert not start.valid[lost].any()
        assert start.valid.float().mean() > 0.6
    assert error["tangent"] > 1.0
    assert error["fused"] < 0.1


def test_a_heading_that_drifts_in_an_outage_bends_the_path_where_the_camera_is_lost():
    """Twenty seconds without a camera in which the heading drifts by 2.5 degrees and back: a heading that does not
    walk, or nodes that do not end where the camera is found, leave three times the error."""
    motion = strolling_motion(60.0, pauses=False)
    time = motion.timestamps
    yaw = np.deg2rad(2.5) * torch.sin(np.pi * ((time - 20.0) / 20.0).clamp(0.0, 1.0))
    lost = (time > 20.0) & (time < 40.0)
    suit, found = drifting(motion, yaw), localized(motion, replace(PERFECT, outages_s=((20.0, 40.0),)))

    def started(**prior):
        settings = InitializationSettings(drift=DriftPrior(**prior))
        start = initialize(suit, found, MOUNT.R, MOUNT.t, settings)
        error = (start.motion.t_world_root - motion.t_world_root).norm(dim=-1)
        return error[lost].mean(), error[~lost].max(), (start.yaw_correction + yaw)[lost].abs().mean()

    within, outside, off = started()
    stretched, _, off_before = started(heading_walk_deg_per_sqrt_min=0.01)
    assert within < 0.5 * stretched
    assert off < 0.75 * off_before
    assert outside < 0.1


def test_the_steps_of_a_fused_path_lead_along_it_and_those_of_a_tangent_are_the_suits():
    motion = strolling_motion(60.0)
    suit = drifting(motion, torch.full((len(motion),), 0.3))
    found = localized(motion, LocalizationNoise(outages_s=((20.0, 40.0),)))
    fused = initialize(suit, found, MOUNT.R, MOUNT.t)
    torch.testing.assert_close(fused.root_step, fused.motion.t_world_root.diff(dim=0))
    tangent = initialize(suit, found, MOUNT.R, MOUNT.t, PAPER)
    torch.testing.assert_close(tangent.root_step.norm(dim=-1), suit.t_world_root.diff(dim=0).norm(dim=-1))


def test_a_jump_that_no_drift_explains_does_not_bend_the_path():
    motion = strolling_motion(60.0, pauses=False)
    found = localized(motion, replace(PERFECT, outages_s=((20.0, 40.0),)))
    later = (found.timestamps > 30.0)[:, None] * torch.tensor([8.0, -6.0, 0.0])
    start = initialize(motion, replace(found, t_world_cam=found.t_world_cam + later), MOUNT.R, MOUNT.t)
    assert start.yaw_correction.abs().max() < np.deg2rad(1.0)


@pytest.mark.parametrize("lean_deg", [0.0, 1.2, 20.0])
def test_gravity_is_found_in_a_map_that_is_not_level(lean_deg):
    """Up to a few degrees; a map that leans as much as a wall is not believed."""
    motion = strolling_motion(60.0)
    lean = rotation.exp(torch.tensor([0.0, np.deg2rad(lean_deg), 0.0]).float())
    found = localized(motion, LocalizationNoise())
    found = replace(found, R_world_cam=lean @ found.R_world_cam, t_world_cam=found.t_world_cam @ lean.mT)
    up = gravity_in_map(motion, found)
    expected = lean[:, 2].double() if lean_deg < 5.0 else torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert torch.linalg.cross(up, expected).norm() < np.deg2rad(0.3)


def test_bursts_of_outliers_do_not_pull_the_path():
    motion = strolling_motion(60.0)
    start = initialize(motion, localized(motion, LocalizationNoise(outlier_share=0.25)), MOUNT.R, MOUNT.t)
    error = (start.motion.t_world_root - motion.t_world_root).norm(dim=-1)
    assert error.max() < 0.08
    assert error.mean() < 0.02


def test_what_cannot_be_started_is_refused():
    motion = strolling_motion(5.0)
    with pytest.raises(WearcapError, match="no localised frame in the suit's time"):
        initialize(motion, localized(motion, LocalizationNoise(outages_s=((0.0, 9.0),))), MOUNT.R, MOUNT.t)
    with pytest.raises(WearcapError, match="path='north'.*tangent, fused"):
        InitializationSettings("north")
    lonely = localized(motion, LocalizationNoise(0, 0, 0, outages_s=((0.0, 2.0), (2.04, 9.0))))
    start = initialize(motion, lonely, MOUNT.R, MOUNT.t)
    assert (start.motion.t_world_root - motion.t_world_root).norm(dim=-1).max() < 0.05
    alone = (lonely.confidence > 0).nonzero()[:1, 0]
    alone = Localization(
        lonely.timestamps[alone] + 0.001, lonely.R_world_cam[alone], lonely.t_world_cam[alone], lonely.confidence[alone]
    )
    assert initialize(motion, alone, MOUNT.R, MOUNT.t).valid.any()
