"""Editing within a manifold: each term has the gradient it should, both solvers find what was planted, nothing else moves."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.metrics.physics import jitter_m_s3
from wearcap.recording import Cue, Motion
from wearcap.systems.mocap_every.energy import (
    Body,
    LatentSolver,
    LatentWeights,
    PixelCue,
    PlaceCue,
    PoseCue,
    Seen,
    contact_slip,
    solve_latent,
)
from wearcap.systems.mocap_every.manifold import MotionManifold
from wearcap.systems.mocap_every.visual_cues import VisualCues, at_frames
from wearcap.tracking.anchor import anchor
from wearcap_testing import recording_of, swaying_motion

SKELETON = xsens23()
WRIST = SKELETON.index("right_wrist")


class Straight(MotionManifold):
    """A manifold that holds every motion: its latents are the motions themselves."""

    def __init__(self):
        super().__init__(5 + 6 * 23, 4, 5, 3)

    def encode(self, motion):
        return motion.transpose(1, 2)

    def decode(self, latent):
        return latent.transpose(1, 2)


def thirty(frames: int = 160, seed: int = 0) -> Motion:
    motion = swaying_motion(frames, seed, fps=30.0)
    return replace(motion, contact_prob=torch.zeros(frames, 4))


def body_of(motion: Motion):
    head = motion.joint("head")
    one = Rigid(head.R[None], head.t[None])
    return Body(*anchor(SKELETON, motion.R_parent_joint[None], one), torch.ones(1, len(motion), 2)), one


def test_terms_are_what_they_are_named_after():
    motion = thirty(20)
    body, head = body_of(motion)
    there = body.T_world_joint.t[:, :, WRIST]
    sure = torch.ones(1, 20)
    off = torch.tensor([0.0, 0.3, 0.4])
    torch.testing.assert_close(PlaceCue(WRIST, there + off, sure).error(body), 0.5 * sure, atol=1e-4, rtol=0)
    camera = Camera.pinhole(640, 480, 120.0)
    seen = Seen(head, camera, Rigid(torch.eye(3), torch.tensor([0.0, 0.0, -1.0])), (), (), ())
    T_world_cam = head @ seen.T_head_cam
    p_cam = (T_world_cam.R.mT @ (there - T_world_cam.t)[..., None])[..., 0]
    pixels, _ = camera.project(p_cam)
    shifted = pixels + torch.tensor([0.1 * camera.fx, 0.0])
    error = PixelCue(WRIST, shifted, sure).error(body, seen)
    assert ((error - 0.1).abs() < 1e-3)[p_cam[..., 2] > 0.05].all()
    assert not error[p_cam[..., 2] <= 0.05].any()
    assert PoseCue(body.R_parent_joint, torch.ones(1, 20, 23)).error(body).max() < 5e-3
    speed = contact_slip(body, [0], 30.0)
    root = body.T_world_joint.t[:, :, 0]
    torch.testing.assert_close(speed, 30 * root.diff(dim=1).norm(dim=-1), atol=2e-2, rtol=0)
    assert not contact_slip(body._replace(contact=torch.zeros(1, 20, 2)), [0], 30.0).any()


@pytest.mark.parametrize("kind", ["lbfgs", "adam"])
def test_solvers_find_the_bottom(kind):
    goal = torch.linspace(-1, 1, 24).reshape(1, 4, 6)
    solver = LatentSolver(kind, 60 if kind == "lbfgs" else 800, 0.02)
    found = solve_latent(torch.zeros(1, 4, 6), lambda z: {"bowl": (z - goal).square().sum((1, 2))}, solver)
    torch.testing.assert_close(found.latent, goal, atol=1e-2, rtol=0)
    assert found.history[-1]["total"] < 1e-3 < found.history[0]["total"]


def test_windows_of_a_batch_are_solved_as_if_alone():
    """Each window has its own curvature and step length: a steep neighbour neither slows nor moves it."""
    goal = torch.linspace(-1, 1, 48).reshape(2, 4, 6)
    steep = torch.tensor([1.0, 1e4])

    def bowls(rows: slice):
        stretch = torch.linspace(1, 30, 24).reshape(4, 6)
        return lambda z: {"bowl": steep[rows] * (stretch * (z - goal[rows]).square()).sum((1, 2))}

    both = solve_latent(torch.zeros(2, 4, 6), bowls(slice(0, 2)), LatentSolver(steps=30))
    alone = [solve_latent(torch.zeros(1, 4, 6), bowls(slice(k, k + 1)), LatentSolver(steps=30)) for k in range(2)]
    torch.testing.assert_close(both.latent, torch.cat([one.latent for one in alone]), atol=1e-5, rtol=0)
    torch.testing.assert_close(both.latent, goal, atol=1e-2, rtol=0)
    totals = [entry["total"] for entry in both.history]
    assert totals == sorted(totals, reverse=True)


def test_feet_at_rest_hold_nothing_up():
    """Where nothing moves, contact has no slope: the wrist still finds its cue."""
    still = swaying_motion(1)
    motion = replace(
        still,
        timestamps=torch.arange(80, dtype=torch.float64) / 30,
        R_parent_joint=still.R_parent_joint.expand(80, -1, -1, -1),
        t_world_root=still.t_world_root.expand(80, -1),
        contact_prob=torch.ones(80, 4),
    )
    recording, places = with_place(motion, slice(30, 50))
    edited, _ = VisualCues(Straight(), LatentWeights(stay=0.1), LatentSolver(steps=120)).edit(
        motion, recording, motion.joint("head")
    )
    assert (edited.joint("right_wrist").t - places).norm(dim=-1)[30:50].mean() < 0.08


def test_an_unknown_solver():
    with pytest.raises(WearcapError, match="no solver"):
        LatentSolver("newton")


def with_place(motion: Motion, shown: slice):
    """A recording that saw the right wrist 15 cm from where the motion has it."""
    recording = recording_of(motion, "seen")
    places = motion.joint("right_wrist").t + torch.tensor([0.0, 0.1, 0.1])
    confidence = torch.zeros(len(motion))
    confidence[shown] = 1.0
    cue = Cue(motion.timestamps, "right_wrist", places, confidence)
    return replace(recording, cues={"right_wrist": cue}), places


def test_only_windows_that_show_something_are_edited():
    motion = thirty()
    recording, places = with_place(motion, slice(70, 80))
    editor = VisualCues(Straight(), LatentWeights(stay=0.1), LatentSolver(steps=60))
    edited, solutions = editor.edit(motion, recording, motion.joint("head"))
    before, after = ((m.joint("right_wrist").t - places).norm(dim=-1)[70:80].mean() for m in (motion, edited))
    assert after < 0.4 * before
    assert solutions[0].history[-1]["total"] < solutions[0].history[0]["total"]
    torch.testing.assert_close(edited.joint("head").t, motion.joint("head").t, atol=1e-4, rtol=0)
    for still in (slice(0, 38), slice(122, 160)):
        torch.testing.assert_close(edited.R_parent_joint[still], motion.R_parent_joint[still], atol=1e-4, rtol=0)


def test_a_detectors_errors_do_not_shake_the_arm():
    motion = thirty()
    recording, places = with_place(motion, slice(40, 120))
    cue = recording.cues["right_wrist"]
    noise = 0.02 * torch.randn(places.shape, generator=torch.Generator().manual_seed(0))
    shaken = replace(recording, cues={"right_wrist": replace(cue, points=places + noise)})
    jitter, error = {}, {}
    for smooth in (0.0, 2.0):
        editor = VisualCues(Straight(), LatentWeights(stay=0.01, contact=0.0), LatentSolver(steps=60), smooth=smooth)
        edited, _ = editor.edit(motion, shaken, motion.joint("head"))
        wrist = edited.joint("right_wrist").t[45:115]
        jitter[smooth] = jitter_m_s3(wrist[:, None], 30.0)
        error[smooth] = (wrist - places[45:115]).norm(dim=-1).mean()
    assert jitter[2.0] < 0.5 * jitter[0.0]
    assert error[2.0] < error[0.0] + 0.005


def test_nothing_seen_nothing_changed():
    motion = thirty()
    recording, _ = with_place(motion, slice(0, 0))
    edited, solutions = VisualCues(Straight()).edit(motion, recording, motion.joint("head"))
    assert edited is motion
    assert not solutions


@pytest.mark.parametrize("frames", [30, 81, 200])
@pytest.mark.parametrize("shown", [slice(0, 5), slice(-5, None)])
def test_captures_of_any_length_and_their_ends(frames, shown):
    motion = thirty(frames)
    recording, places = with_place(motion, shown)
    edited, _ = VisualCues(Straight(), LatentWeights(stay=0.1)).edit(motion, recording, motion.joint("head"))
    before, after = ((m.joint("right_wrist").t - places).norm(dim=-1)[shown].mean() for m in (motion, edited))
    assert len(edited) == frames
    assert after < 0.6 * before


def test_cues_are_taken_at_the_nearest_frame():
    times = torch.arange(10, dtype=torch.float64) / 30
    cue = Cue(times[::3] + 0.01, "right_wrist", torch.arange(8.0).reshape(4, 2), torch.ones(4))
    found = at_frames(cue, times)
    assert found.confidence.tolist() == [1, 0, 0, 1, 0, 0, 1, 0, 0, 1]
    assert found.points[3].tolist() == [2.0, 3.0]
    lost = replace(cue, points=torch.full((4, 2), torch.nan))
    assert not at_frames(lost, times).confidence.any()
    assert not at_frames(
        replace(cue, timestamps=times[:0], points=cue.points[:0], confidence=cue.confidence[:0]), times
    ).confidence.any()
