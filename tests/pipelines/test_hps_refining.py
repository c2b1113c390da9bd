"""`refine=hps`: planted errors of a predicted walk, held against the planted truth; without it nothing changes."""

from dataclasses import replace

import pytest
import torch

import wearcap
from walking_person import sound_recording
from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.cli.conf import compose, load_pipeline
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import HeadStream, Motion, PointCloud, Recording
from wearcap.runtime.system import Captured, CaptureInput, LearnedSystem
from wearcap.scene.scan import Scan
from wearcap.systems.hps.refining import initialized
from wearcap.tracking.head_path import head_path

RAISED_M = 0.05


class Predicted(LearnedSystem):
    """A network that predicts a given motion."""

    name = "predicted"
    motion: Motion

    def motions(self, sources, seeds):
        return [self.motion for _ in sources]


def walk_above_its_floor(seconds: float = 6.0) -> tuple[Recording, Motion]:
    """A recording whose points lie higher than the walker's soles, and the walk as a prediction that is displaced."""
    recording = sound_recording(seconds)
    assert recording.motion is not None
    assert recording.points is not None
    assert recording.contacts is not None
    lifted = PointCloud(recording.points.points_world + torch.tensor([0.0, 0.0, RAISED_M]))
    displaced = recording.motion.t_world_root + torch.tensor([0.3, -0.2, 0.1])
    motion = replace(recording.motion, t_world_root=displaced, contact_prob=recording.contacts.feet.float())
    return replace(recording, points=lifted), motion


def standing(motion: Motion, recording: Recording) -> torch.Tensor:
    """Heights (m) of the soles where they truly stand."""
    assert recording.contacts is not None
    soles = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)
    return soles[..., 2][recording.contacts.feet]


@pytest.fixture(scope="module")
def refine():
    return wearcap.load("hmd2", "refine=hps").refine


@pytest.mark.parametrize("ground", ["points", "scan"])
def test_planted_feet_come_to_the_floor_and_the_head_to_where_it_was_measured(ground, refine):
    recording, motion = walk_above_its_floor()
    source = CaptureInput(recording)
    if ground == "scan":
        level = torch.cartesian_prod(torch.arange(-4, 4, 0.03), torch.arange(-4, 4, 0.03), torch.tensor([RAISED_M]))
        source = CaptureInput(replace(recording, points=None), scan=Scan(level.float().numpy()))
    captured = refine(motion, source)
    refined, true = captured.motion, recording.motion
    assert standing(true, recording).mean() < RAISED_M - 0.04, "without refinement soles are deep in the floor"
    skin_m = (
        0.0 if ground == "points" else 0.007
    )  # on a scan stands the skin, whose soles are rounder than the skeleton's
    assert (standing(refined, recording) - RAISED_M + skin_m).abs().mean() < 0.02
    head, measured = refined.joint("head"), true.joint("head")
    assert (motion.joint("head").t - measured.t).norm(dim=-1).min() > 0.3
    assert (head.t - measured.t).norm(dim=-1).mean() < 0.015
    totals = [step["total"] for step in captured.report["energy"]]
    assert totals[-1] < totals[0]
    assert refined.provenance["refine"] == "hps"


def test_sliding_feet_are_held(refine):
    """Both hips swing to and fro more than once a second, and with them the feet, which stay level."""
    recording, motion = walk_above_its_floor()
    R, skeleton = motion.R_parent_joint.clone(), motion.skeleton
    swing = rotation.about_axis("y", 0.05 * torch.sin(8.0 * motion.timestamps.float()))
    for hip, knee, ankle in (
        skeleton.indices(f"{side}_hip", f"{side}_knee", f"{side}_ankle") for side in ("left", "right")
    ):
        before, R[:, hip] = R[:, hip] @ R[:, knee], swing @ R[:, hip]
        R[:, ankle] = (R[:, hip] @ R[:, knee]).mT @ before @ R[:, ankle]
    sliding = replace(motion, R_parent_joint=R)
    level = replace(recording, points=PointCloud(recording.points.points_world - torch.tensor([0.0, 0.0, RAISED_M])))
    refined = refine(sliding, CaptureInput(level)).motion
    before, after, least = (slid_m_s(each, recording) for each in (sliding, refined, recording.motion))
    assert before > 2 * least, "legs of the planted walk are too short for its longest steps"
    assert after < 1.05 * least


def slid_m_s(motion: Motion, recording: Recording) -> float:
    """Mean speed of soles that truly stand."""
    soles = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES)
    stays = recording.contacts.feet[1:] & recording.contacts.feet[:-1]
    return (60.0 * soles.diff(dim=0).norm(dim=-1))[stays].mean().item()


def test_without_refinement_a_capture_is_what_the_network_predicts():
    recording, motion = walk_above_its_floor(2.0)
    system = Predicted()
    system.motion = replace(motion, provenance={"note": "planted"})
    plain = system.capture([recording], [0])[0]
    assert plain.motion is system.motion
    other = replace(motion, t_world_root=motion.t_world_root + 1)
    refined = Predicted(refine=lambda motion, source: Captured(other, {"stopped": "here"}))
    refined.motion = system.motion
    captured = refined.capture([recording], [0])[0]
    assert captured.motion is other
    assert captured.report == {"notes": ["planted"], "stopped": "here"}
    with pytest.raises(WearcapError, match="a stream with refine=…"):
        refined.stream()


def test_a_floor_that_only_the_head_tells_pulls_less(refine):
    """The walker stoops by centimetres: from the head alone the floor seems lower than it is."""
    recording, motion = walk_above_its_floor(4.0)
    unseen = replace(recording, points=None)
    moved = [
        (standing(replace(refine, head_floor=share)(motion, CaptureInput(unseen)).motion, recording)).mean().item()
        for share in (0.0, refine.head_floor, 1.0)
    ]
    assert moved[0] > moved[1] > moved[2]


def test_captures_are_not_refined_unless_it_is_wished():
    assert "refine" not in compose("capture", ["recording=none"]).pipeline
    assert "refine" not in compose("evaluate").pipeline
    with pytest.raises(WearcapError, match="HPS is no system whose network predicts"):
        load_pipeline(None, compose("capture", ["recording=none", "pipeline=hps", "refine=hps"]).pipeline, "cpu")


def test_gaps_of_the_head_s_path_hold_nothing():
    recording, motion = walk_above_its_floor(4.0)
    head = recording.head
    kept = (head.timestamps < 1.0) | (head.timestamps > 2.0)
    path = head_path(
        replace(
            recording,
            head=HeadStream(
                *(part[kept] for part in (head.timestamps, head.R_world_device, head.t_world_device)),
                head.R_head_device,
                head.t_head_device,
            ),
        ),
        motion.skeleton,
        60.0,
    )
    assert torch.equal(initialized(motion, path).valid, kept)
