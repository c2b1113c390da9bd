"""Scores of motions whose errors are planted: what is five centimetres off is measured as five centimetres off."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.rivals import hps_scores as hps
from benchmarks.tables import hps_outages as outages
from wearcap.body.anny_body import anny_body
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.position import joint_error_cm
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import ContactTrack, Intervals
from wearcap.scene.scan import Scan

SECONDS, FPS, SPEED = 2.0, 60.0, 0.5


def gliding(speed: float = SPEED) -> Motion:
    """A T-pose that slides forward over the floor, all patches of its feet in contact."""
    skeleton, frames = xsens23(), int(SECONDS * FPS)
    time = torch.arange(frames, dtype=torch.float64) / FPS
    root = torch.stack([speed * time, 0 * time, 0 * time + skeleton.root_height], -1).float()
    R = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    return Motion(time, skeleton, R, root, torch.ones(frames, len(FOOT_PATCHES)))


def moved(motion: Motion, *shift_m: float) -> Motion:
    return replace(motion, t_world_root=motion.t_world_root + torch.tensor(shift_m))


@pytest.fixture(scope="module")
def recording() -> Recording:
    motion = gliding()
    touching = torch.ones(len(motion), 4, dtype=torch.bool)
    touching[30:] = False
    contacts = ContactTrack(motion.timestamps, FOOT_PATCHES, touching)
    return Recording("glide", suit=motion, motion=motion, contacts=contacts)


@pytest.fixture(scope="module")
def truth(recording: Recording) -> hps.HpsTruth:
    rng = np.random.default_rng(0)
    floor = rng.uniform([-1, -1, 0], [2.5, 1, 0], (40_000, 3)).astype(np.float32)
    motion, body = recording.motion, anny_body(xsens23())
    assert motion is not None
    clouds = [hps.RigCloud(motion.timestamps[k].item(), body.vertices(motion.T_world_joint[k])) for k in (20, 60)]
    return hps.HpsTruth.of(recording, Scan(floor), [clouds[:1], clouds])


def test_the_truth_scores_nothing(truth: hps.HpsTruth):
    scores = hps.score_hps(truth.motion, truth)
    assert len(truth.motion) == 60
    assert len(scores.literal) == len(scores.surface) == 2
    assert max(part.mean_cm for part in (*scores.literal, *scores.surface)) < 0.01
    assert scores.joints["root_cm"] == scores.joints["mpjpe_cm"] == scores.drift.error_cm[0] == 0.0


def test_a_body_that_is_lifted_by_five_centimetres_is_five_centimetres_off(truth: hps.HpsTruth):
    scores, lifted = hps.score_hps(truth.motion, truth), hps.score_hps(moved(truth.motion, 0.0, 0.0, 0.05), truth)
    assert lifted.joints["root_cm"] == pytest.approx(5.0, abs=1e-3)
    assert lifted.joints["mpjpe_cm"] == pytest.approx(5.0, abs=1e-3)
    assert lifted.feet.distance_cm - scores.feet.distance_cm == pytest.approx(5.0, abs=0.01)
    assert lifted.drift.error_cm == pytest.approx((5.0,), abs=1e-3)


def test_feet_slide_as_far_as_they_go_from_frame_to_frame(truth: hps.HpsTruth):
    feet = hps.score_hps(truth.motion, truth).feet
    assert feet.sliding_cm == pytest.approx(100 * SPEED / 30, abs=1e-3)
    standing = replace(truth.motion, t_world_root=truth.motion.t_world_root[:1].expand(60, 3))
    assert hps.score_hps(standing, truth).feet.sliding_cm == pytest.approx(0.0, abs=1e-4)


def test_contacts_are_those_asked_for(truth: hps.HpsTruth):
    scores = hps.score_hps(truth.motion, truth)
    assert scores.feet.contacts == 4 * scores.feet_true_contact.contacts
    assert scores.feet_true_contact.contacts > 0


def test_chamfer_grows_with_the_shift_up_to_all_of_it(truth: hps.HpsTruth):
    near, far = (
        hps.interval_chamfer(moved(truth.motion, 0.0, 0.0, shift), truth.body, truth.visits[1])
        for shift in (0.05, 10.0)
    )
    for literal, surface in (near, far):
        assert surface.cloud_to_body_cm <= literal.cloud_to_body_cm + 1e-9
        assert surface.body_to_cloud_cm == literal.body_to_cloud_cm
    assert 0.5 < near[0].mean_cm < 5.0
    tall = (truth.body.rest_vertices[:, 2].max() - truth.body.rest_vertices[:, 2].min()).item()
    assert 1000 - 100 * tall < far[0].mean_cm < 1000.0


def test_clouds_are_met_at_their_own_time(truth: hps.HpsTruth):
    late = replace(truth.motion, timestamps=truth.motion.timestamps + 0.2)
    off = hps.interval_chamfer(late, truth.body, truth.visits[1])[0]
    assert off.mean_cm > 1.0, "10 cm of path"
    with pytest.raises(WearcapError, match="no captured frame at 1.00 s"):
        hps.interval_chamfer(truth.motion.sliced(0, 20), truth.body, truth.visits[1])
    assert hps.nearest_frames(truth.motion.timestamps, torch.tensor([0.34, 1.01]).double()).tolist() == [10, 30]


def test_a_captured_turn_leaves_the_root_where_it_is_and_moves_the_joints(truth: hps.HpsTruth):
    R = truth.motion.R_parent_joint.clone()
    R[:, 0] = about_axis("z", torch.tensor(np.pi))
    turned = replace(truth.motion, R_parent_joint=R)
    error = joint_error_cm(turned.T_world_joint.t, truth.motion.T_world_joint.t)
    wrist = truth.motion.skeleton.index("left_wrist")
    reach = truth.motion.skeleton.rest_joints[wrist] - truth.motion.skeleton.rest_joints[0]
    assert error[:, 0].abs().max() < 1e-4
    assert error[0, wrist].item() == pytest.approx(200 * reach[:2].norm().item(), rel=1e-4)


def test_the_slope_counts_path_length_and_not_time():
    distance = torch.cat([torch.linspace(0, 100, 500), torch.full((5000,), 100.0), torch.linspace(100, 400, 1500)])
    grown = hps.drift(distance.double(), (3.0 + 0.02 * distance).double())
    assert grown.slope_cm_per_100m == pytest.approx(2.0, abs=0.15)
    assert len(grown.distance_m) == 20
    assert grown.error_cm[0] == pytest.approx(3.2, abs=0.05)
    level = hps.drift(distance.double(), torch.full_like(distance, 4.0).double())
    assert level.slope_cm_per_100m == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(hps.drift(distance[:50].double(), distance[:50].double()).slope_cm_per_100m)


def test_the_path_length_is_that_over_the_ground():
    motion = gliding(1.0)
    up = replace(
        motion, t_world_root=motion.t_world_root + torch.linspace(0, 3, 120)[:, None] * torch.tensor([0, 0, 1])
    )
    assert hps.travelled_m(up)[-1].item() == pytest.approx(119 / 60, abs=1e-4)


def intervals(*spans: tuple[float, float]) -> Intervals:
    start, stop = (torch.tensor(side, dtype=torch.float64) for side in zip(*spans))
    return Intervals(start, stop, torch.zeros(len(spans)), ("stand",) * len(spans))


def test_instants_lie_evenly_within_their_interval():
    times = hps.visit_times(intervals((10.0, 20.0), (30.0, 32.0)), 4)
    assert torch.allclose(times[0], torch.tensor([11.25, 13.75, 16.25, 18.75]).double())
    assert (times[1] > 30).all()
    assert (times[1] < 32).all()


def test_outages_are_planted_in_the_middle_of_the_longest_walks():
    stops = intervals((0.0, 10.0), (10.5, 20.0), (100.0, 110.0), (310.0, 320.0))
    short, long = outages.planted_outages(stops, 330.0, (30.0, 60.0))
    assert (short.start_s, short.length_s) == (45.0, 30.0)
    assert (long.start_s, long.length_s) == (180.0, 60.0)
    assert outages.planted_outages(stops, 330.0, (900.0,))[0].length_s == 190.0
    times = torch.arange(330, dtype=torch.float64)
    assert int(short.frames(times).sum()) == 30
    with pytest.raises(WearcapError, match="6 outages"):
        outages.planted_outages(stops, 330.0, (1.0,) * 6)
    with pytest.raises(WearcapError, match="no room"):
        outages.planted_outages(intervals((0.0, 10.0), (11.0, 20.0)), 21.0, (1.0,))


def test_a_disturbance_is_measured_in_its_own_frames():
    motion = gliding()
    frames = torch.zeros(len(motion), dtype=torch.bool)
    frames[50:80] = True
    shift = torch.zeros(len(motion), 3)
    shift[frames, 1] = 0.08
    disturbed = replace(motion, t_world_root=motion.t_world_root + shift + torch.tensor([0.0, 0.02, 0.0]))
    within = outages.disturbance(disturbed, moved(motion, 0.0, 0.02, 0.0), motion, frames)
    assert within.root_cm == pytest.approx(10.0, abs=1e-3)
    assert within.root_ratio == pytest.approx(5.0, rel=1e-3)
    assert within.joint_ratio == pytest.approx(5.0, rel=1e-3)
    assert outages.disturbance(disturbed, motion, motion, ~frames).root_cm == pytest.approx(2.0, abs=1e-3)


def test_captures_of_another_length_and_recordings_without_truth_are_refused(truth: hps.HpsTruth, recording: Recording):
    with pytest.raises(WearcapError, match="the same timestamps"):
        hps.score_hps(truth.motion.sliced(0, 40), truth)
    with pytest.raises(WearcapError, match="nothing to measure a capture against"):
        hps.HpsTruth.of(replace(recording, contacts=None), Scan(np.zeros((10, 3), np.float32)), [])
