"""Refinement: smoothing without delay, feet that stand, arms to tracked wrists; whole, in pieces, and in streams."""

from dataclasses import asdict, replace

import pytest
import torch

from walking_person import walk
from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES, WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.metrics.physics import foot_contact, foot_points, foot_skate_cm_s, jitter_m_s3
from wearcap.recording import Motion
from wearcap.recording.timing import joined
from wearcap.tracking.foot_lock import FootLock
from wearcap.tracking.refinement import FADE_S, Measured, Refinement, Refiner, with_limbs_bent

FPS = 30.0
FEET = FootLock(
    begin_prob=0.7,
    end_prob=0.5,
    shortest=3,
    settle=8,
    fade=4,
    fastest_m_s=3.0,
    farthest_m=0.2,
    leak_s=20.0,
    floor_within_m=0.05,
    raise_m=0.2,
)
LOCKED = Refinement(smooth=0.0, feet=FEET, wrists=False)


def truth(seconds: float = 4.0) -> tuple[Motion, torch.Tensor]:
    motion, contact = walk(torch.arange(int(seconds * FPS), dtype=torch.float64) / FPS)
    return replace(motion, contact_prob=contact.float()), contact


def measured(motion: Motion) -> Measured:
    return Measured.of(motion.joint("head"), torch.zeros(len(motion)))


def refined(refinement: Refinement, motion: Motion, known: Measured | None = None) -> Motion:
    return refinement.refined(motion, known or measured(motion), [(0, len(motion))], FPS, anchored=True)


def slid(motion: Motion, speed_m_s: float = 0.25, sink_m: float = 0.0) -> Motion:
    """The walk with both feet sliding to and fro, and sunk into the floor."""
    way = speed_m_s / (2 * torch.pi) * (2 * torch.pi * motion.timestamps).sin()
    offset = torch.stack([way, 0 * way, torch.full_like(way, -sink_m)], -1).float()
    return with_limbs_bent(motion, offset[:, None].expand(-1, 2, 3))


def skate(motion: Motion, contact: torch.Tensor) -> float:
    return foot_skate_cm_s(foot_points(motion.skeleton, motion.T_world_joint), foot_contact(contact), FPS).item()


def test_a_slid_walk_stands_again():
    motion, contact = truth()
    bad = slid(motion, sink_m=0.02)
    good = refined(LOCKED, bad)
    assert skate(bad, contact) > 10
    assert skate(good, contact) < 1.1 * skate(motion, contact) < 0.3 * skate(bad, contact)
    errors = [(each.T_world_joint.t - motion.T_world_joint.t).norm(dim=-1).mean() for each in (bad, good)]
    assert errors[1] < errors[0]
    soles = site_positions(good.skeleton, good.T_world_joint, FOOT_PATCHES)[..., 2]
    assert soles.min() > -0.005
    torch.testing.assert_close(good.joint("left_ankle").R, bad.joint("left_ankle").R, atol=1e-5, rtol=0)


def test_what_stands_already_is_left_alone():
    motion, _ = truth()
    moved = (refined(LOCKED, motion).T_world_joint.t - motion.T_world_joint.t).norm(dim=-1)
    assert moved.max() < 0.01


def test_noise_of_contacts_does_not_pop():
    motion, contact = truth()
    random = torch.Generator().manual_seed(0)
    noise = 0.18 * torch.randn(contact.shape, generator=random)
    spikes = torch.rand(contact.shape, generator=random) < 0.04
    bad = replace(slid(motion), contact_prob=((0.9 * contact.float() + noise) * ~spikes).clamp(0, 1))
    good = refined(LOCKED, bad)
    step = (good.T_world_joint.t - bad.T_world_joint.t).diff(dim=0).norm(dim=-1)
    assert step.max() < 0.05
    assert skate(good, contact) < skate(bad, contact)


@pytest.mark.parametrize("prob", [0.6, 0.0])
def test_contacts_that_are_not_believed_change_nothing(prob):
    motion, _ = truth()
    bad = replace(slid(motion), contact_prob=torch.full((len(motion), 4), prob))
    torch.testing.assert_close(refined(LOCKED, bad).R_parent_joint, bad.R_parent_joint, atol=1e-5, rtol=0)


def test_a_contact_that_the_foot_contradicts_is_none():
    motion, _ = truth()
    running = replace(slid(motion, 8.0), contact_prob=torch.ones(len(motion), 4))
    slow = replace(FEET, fastest_m_s=0.1, raise_m=0.0)
    good = refined(replace(LOCKED, feet=slow), running)
    torch.testing.assert_close(good.R_parent_joint, running.R_parent_joint, atol=1e-5, rtol=0)


def test_knees_bend_forward_and_legs_reach_no_farther_than_they_can():
    motion, _ = truth()
    length = 0.85
    for offset in ((0.0, 0.0, 0.2), (0.0, 0.0, -0.5), (0.3, 0.0, -0.2), (-0.2, 0.1, 0.1)):
        moved = with_limbs_bent(motion, torch.tensor(offset).expand(len(motion), 2, 3))
        hip, knee, ankle = (moved.joint(f"left_{name}") for name in ("hip", "knee", "ankle"))
        before = (motion.joint("left_ankle").t - motion.joint("left_hip").t).norm(dim=-1)
        assert ((ankle.t - hip.t).norm(dim=-1) < before.clamp_min(0.996 * length) + 1e-5).all()
        middle = knee.t - torch.lerp(hip.t, ankle.t, 0.5)
        forward = motion.joint("pelvis").R[..., 0]
        assert (middle * forward).sum(-1).min() > -0.003  # straight legs: the bones differ by a centimetre
        torch.testing.assert_close(moved.T_world_joint.t[:, 0], motion.T_world_joint.t[:, 0])
        for a, b in ((hip, knee), (knee, ankle)):
            assert ((a.t - b.t).norm(dim=-1) - (0.43 if a is hip else 0.42)).abs().max() < 1e-4


def test_a_straight_knee_bends_forward_when_its_foot_is_raised():
    motion, _ = truth()
    R = torch.eye(3).repeat(len(motion), len(motion.skeleton), 1, 1)
    back = rotation.about_axis("y", torch.tensor(-0.02))  # bent backwards by a degree
    R[:, motion.skeleton.index("left_knee")] = back
    stiff = replace(motion, R_parent_joint=R)
    raised = with_limbs_bent(stiff, torch.tensor([0.0, 0.0, 0.1]).expand(len(motion), 2, 3))
    for side in ("left", "right"):
        assert (raised.joint(f"{side}_knee").t - raised.joint(f"{side}_hip").t)[:, 0].min() > 0.1


def test_smoothing_takes_the_noise_and_no_time():
    motion, _ = truth()
    noise = rotation.exp(0.03 * torch.randn(*motion.R_parent_joint.shape[:2], 3, generator=torch.manual_seed(0)))
    bad = replace(motion, R_parent_joint=motion.R_parent_joint @ noise)
    known = measured(motion)
    good = refined(Refinement(1.5, None, False), bad, known)
    errors = [(each.T_world_joint.t - motion.T_world_joint.t).norm(dim=-1).mean() for each in (bad, good)]
    assert errors[1] < 0.7 * errors[0]
    jitter = [jitter_m_s3(each.T_world_joint.t, FPS) for each in (bad, good)]
    assert jitter[1] < 0.3 * jitter[0]
    head = good.joint("head")
    torch.testing.assert_close(head.t, known.t_world_head, atol=1e-5, rtol=0)
    torch.testing.assert_close(head.R, known.R_world_head, atol=1e-4, rtol=0)
    # A steady turn is neither delayed nor changed.
    turn = rotation.about_axis("z", 0.1 * torch.arange(40.0))
    steady = replace(motion.sliced(0, 40), R_parent_joint=turn[:, None].expand(-1, len(motion.skeleton), 3, 3))
    same = refined(Refinement(1.5, None, False), steady).R_parent_joint
    torch.testing.assert_close(same[5:-5, 0], turn[5:-5], atol=1e-5, rtol=0)


@pytest.mark.parametrize("piece", [1, 3, 7, 50])
@pytest.mark.parametrize("anchored", [True, False])
def test_pieces_give_what_the_whole_gives(piece, anchored):
    motion, _ = truth()
    random = torch.Generator().manual_seed(1)
    prob = (motion.contact_prob + 0.3 * torch.randn(len(motion), 4, generator=random)).clamp(0, 1)
    bad = replace(slid(motion, 0.6, 0.03), contact_prob=prob)
    wrists = motion.T_world_joint[:, motion.skeleton.indices(*WRISTS)]
    known = Measured.of(motion.joint("head"), torch.zeros(len(motion)), wrists)
    known.given[40:43] = True
    refinement = Refinement(0.8, FEET, True)
    whole = refinement.refined(bad, known, [(0, len(bad))], FPS, anchored)
    refiner, parts, waits = Refiner(refinement, bad.skeleton, FPS, anchored), [], []
    for start in range(0, len(bad), piece):
        stop = min(start + piece, len(bad))
        parts += refiner.push(bad.sliced(start, stop), known.part(slice(start, stop)))
        waits.append(stop - sum(len(part) for part in parts))
    parts += refiner.finish()
    assert max(waits) <= refinement.lookahead
    found = joined(parts)
    torch.testing.assert_close(found.timestamps, bad.timestamps)
    torch.testing.assert_close(found.T_world_joint.t, whole.T_world_joint.t, atol=2e-5, rtol=0)
    torch.testing.assert_close(whole.R_parent_joint[40:43], bad.R_parent_joint[40:43])
    assert refiner.finish() == []


def test_stretches_know_nothing_of_each_other():
    motion, _ = truth()
    bad, refinement = slid(motion), Refinement(1.0, FEET, False)
    parts = refinement.refined(bad, measured(motion), [(0, 50), (60, len(bad))], FPS, anchored=True)
    for start, stop in ((0, 50), (60, len(bad))):
        alone = bad.sliced(start, stop)
        expected = refinement.refined(alone, measured(motion).part(slice(start, stop)), [(0, stop - start)], FPS, True)
        torch.testing.assert_close(parts.R_parent_joint[start:stop], expected.R_parent_joint)
    torch.testing.assert_close(parts.R_parent_joint[50:60], bad.R_parent_joint[50:60])


def test_one_frame_is_enough():
    motion, _ = truth()
    one = motion.sliced(0, 1)
    assert refined(Refinement(1.0, FEET, False), one).R_parent_joint.isfinite().all()


@pytest.mark.parametrize("piece", [4, 200])
def test_arms_go_over_to_wrists_that_come_into_view_and_leave_those_that_were_lost(piece):
    motion, _ = truth()
    wrists = motion.T_world_joint[:, motion.skeleton.indices(*WRISTS)]
    goal = Rigid(wrists.R, wrists.t + torch.tensor([0.0, 0.0, 0.05]))
    seen, fade = torch.ones(len(motion), 2, dtype=torch.bool), round(FADE_S * FPS)
    seen[:40, 0], seen[90:, 0] = False, False
    goal.t[~seen] = 1e3  # never looked at
    known, refiner, parts = Measured.of(motion.joint("head"), torch.zeros(len(motion)), goal, seen), None, []
    refiner = Refiner(Refinement(0.0, None, True), motion.skeleton, FPS, False)
    for start in range(0, len(motion), piece):
        stop = min(start + piece, len(motion))
        parts += refiner.push(motion.sliced(start, stop), known.part(slice(start, stop)))
    found = joined([*parts, *refiner.finish()])
    left, right = (found.joint(name).t - motion.joint(name).t for name in WRISTS)
    torch.testing.assert_close(right[:, 2], torch.full((len(motion),), 0.05), atol=1e-3, rtol=0)
    share = torch.zeros(len(motion))
    share[40:90] = (torch.arange(1, 51) / fade).clamp_max(1)
    torch.testing.assert_close(left[:90, 2], 0.05 * share[:90], atol=1e-3, rtol=0)
    assert left[90 + fade :].norm(dim=-1).max() < 1e-4, "as predicted again"
    assert left.diff(dim=0).norm(dim=-1).max() < 0.1, "and no jump on the way"


def test_arms_reach_tracked_wrists_or_as_near_as_they_can():
    motion, _ = truth()
    skeleton, wrists = motion.skeleton, motion.skeleton.indices(*WRISTS)
    T = motion.T_world_joint[:, wrists]
    random = torch.Generator().manual_seed(0)
    goal = Rigid(T.R @ rotation.exp(0.3 * torch.randn(T.t.shape, generator=random)), T.t.clone())
    shoulder = motion.joint("left_shoulder").t
    goal.t[:, 0] = torch.lerp(shoulder, goal.t[:, 0], 0.8) + 0.03
    goal.t[:, 1] += 5 * (T.t[:, 1] - motion.joint("right_shoulder").t)
    found = with_limbs_bent(motion, T_world_wrist=goal)
    left, right = (found.joint(name) for name in WRISTS)
    torch.testing.assert_close(left.t, goal.t[:, 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(found.T_world_joint.R[:, wrists], goal.R, atol=1e-4, rtol=0)
    reach = right.t - motion.joint("right_shoulder").t
    wanted = goal.t[:, 1] - motion.joint("right_shoulder").t
    assert torch.nn.functional.cosine_similarity(reach, wanted, dim=-1).min() > 0.999
    assert (reach.norm(dim=-1) - 0.54).abs().max() < 1e-3
    others = [joint for joint in range(len(skeleton)) if "left" not in skeleton.joint_names[joint]]
    others = [joint for joint in others if "right" not in skeleton.joint_names[joint]]
    torch.testing.assert_close(found.T_world_joint.t[:, others], motion.T_world_joint.t[:, others])


def test_contact_probabilities_that_are_no_numbers_are_refused():
    motion, _ = truth()
    motion.contact_prob[3, 1] = torch.nan
    with pytest.raises(WearcapError, match="contact probabilities that are NaN or infinite"):
        refined(LOCKED, motion)
    assert refined(Refinement(1.0, None, False), motion).R_parent_joint.isfinite().all()


def test_plain_values_make_the_same_refinement():
    for refinement in (LOCKED, Refinement(1.0, None, True)):
        assert Refinement.of(asdict(refinement)) == refinement
    assert Refinement.of(None) is None
