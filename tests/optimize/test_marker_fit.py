"""Bodies and poses from optical markers: a planted person, derivatives, gaps, sets of markers."""

from dataclasses import replace

import pytest
import torch

from marker_person import markers_of, person, squats
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.metrics.gait import knee_deg
from wearcap.optimize import markers as fit

TRUE = squats(person())
SEEN = markers_of(TRUE)
TRIALS = [SEEN, markers_of(squats(person(), 3.0))]


@pytest.fixture(scope="module")
def body() -> fit.MarkerBody:
    return fit.fit_body(TRIALS)


def test_a_planted_person_is_found(body):
    motion, distance = fit.fit_motion(body, SEEN)
    assert distance.square().mean().sqrt() < 0.004
    assert (knee_deg(motion) - knee_deg(TRUE)).abs().max() < 4
    for name, within in (("left_knee", 0.015), ("right_ankle", 0.012), ("left_wrist", 0.015), ("left_hip", 0.02)):
        assert (motion.joint(name).t - TRUE.joint(name).t).norm(dim=-1).max() < within, name
    found, true = (skeleton.t_parent_joint.norm(dim=-1) for skeleton in (body.skeleton, TRUE.skeleton))
    legs = body.skeleton.indices("left_knee", "left_ankle")
    assert (found[legs] - true[legs]).abs().max() < 0.012


@pytest.mark.parametrize("standing_deg", [2.0, 10.0, 25.0])
def test_standing_knees_are_as_bent_as_they_are(standing_deg):
    true = squats(person(1.0), 2.0, standing_deg)
    seen = markers_of(true, off_m=0.0)
    motion, _ = fit.fit_motion(fit.fit_body([seen]), seen)
    assert knee_deg(motion)[[0, -1]].mean().item() == pytest.approx(standing_deg, abs=3)


def test_gradients_are_those_of_the_energy(body):
    """Differences of the energy along every component of the step; the residuals' along bones and offsets."""
    frames = torch.tensor([3, 90, 150])
    seen = fit._seen(body, SEEN)[frames]
    R, t = TRUE.R_parent_joint[frames].double(), TRUE.t_world_root[frames].double() + 0.02
    R[:, 4] = R[:, 4] @ rotation.exp(torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64))
    seen.weight[1, 5:9] = 0.5
    R = torch.linalg.svd(R).U @ torch.linalg.svd(R).Vh
    g, H, *_ = fit._model(body, seen, R, t)
    assert torch.linalg.eigvalsh(H).min() > 0
    for component in range(g.shape[1]):
        step = torch.zeros_like(g)
        step[:, component] = 1e-5
        ahead, behind = (fit._energy(body, seen, *fit._moved(R, t, sign * step)) for sign in (1, -1))
        assert torch.allclose((ahead - behind) / 4e-5, g[:, component], rtol=1e-4, atol=1e-3), component


def test_shared_derivatives_are_those_of_the_markers(body):
    frames = torch.tensor([3, 90])
    R, t = TRUE.R_parent_joint[frames].double(), TRUE.t_world_root[frames].double()
    base = body.skeleton.t_parent_joint.double()
    bones = torch.zeros(1, *base.shape, dtype=torch.float64)
    bones[0, body.skeleton.index("left_knee"), 2] = base[body.skeleton.index("left_knee"), 2]
    J = fit._shared_derivative(body, bones, R, t, torch.ones(2, len(body.names), dtype=torch.float64))
    longer = replace(body, skeleton=body.skeleton.with_offsets((base + 0.05 * bones[0]).float()))
    moved = (longer.places(R, t)[2] - body.places(R, t)[2]).flatten(1)
    assert torch.allclose(J[..., 0] * 0.05, moved, atol=1e-6)
    step = torch.randn(len(body.names), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = (replace(body, t_b_marker=body.t_b_marker + step).places(R, t)[2] - body.places(R, t)[2]).flatten(1)
    assert torch.allclose(J[..., 1:] @ step.flatten(), moved, atol=1e-6)


def test_dropped_markers_are_masked_and_poses_do_not_jump(body):
    places = SEEN.t_world_marker.clone()
    gone = [SEEN.names.index(name) for name in ("LKNE", "RFHD", "LASI")]
    places[100:140, gone] = torch.nan
    whole, _ = fit.fit_motion(body, SEEN)
    motion, distance = fit.fit_motion(body, replace(SEEN, t_world_marker=places))
    assert distance[100:140, [body.names.index("LKNE")]].isnan().all()
    assert (motion.T_world_joint.t - whole.T_world_joint.t).norm(dim=-1).max() < 0.02
    steps = [each.T_world_joint.t.diff(n=2, dim=0).norm(dim=-1).max() for each in (motion, whole)]
    assert steps[0] < 1.5 * steps[1]


def test_markers_far_off_do_not_draw_the_body(body):
    places = SEEN.t_world_marker.clone()
    places[:, SEEN.names.index("RTHI")] += torch.tensor([0.0, 0.0, 0.10], dtype=torch.float64)  # placed anew
    places[50:60, SEEN.names.index("LWRA")] += 0.4  # a ghost
    motion, distance = fit.fit_motion(body, replace(SEEN, t_world_marker=places))
    assert distance[:, body.names.index("RTHI")].median() < 0.025
    assert (motion.joint("right_knee").t - TRUE.joint("right_knee").t).norm(dim=-1).max() < 0.02
    assert (motion.joint("left_elbow").t - TRUE.joint("left_elbow").t).norm(dim=-1).max() < 0.03


def test_names_with_subjects_and_strange_markers():
    keep = [name for name in SEEN.names if name not in ("RBAK", "LUPA", "STRN")]
    places = torch.stack(
        [SEEN.t_world_marker[:, SEEN.names.index(name)] for name in keep] + [torch.ones(400, 3).double()], 1
    )
    body = fit.fit_body([replace(SEEN, names=(*(f"Anna:{n.lower()}" for n in keep), "wand"), t_world_marker=places)])
    assert set(body.names) == set(keep)


@pytest.mark.parametrize(("gone", "part"), [("LASI LPSI", "pelvis"), ("RKNE RTOE", "right leg"), ("LFHD RBHD", "head")])
def test_a_part_without_markers_is_named(gone, part):
    names = tuple(f"x{name}" if name in gone.split() else name for name in SEEN.names)
    with pytest.raises(WearcapError, match=f"{part}.*{gone.split()[0]}"):
        fit.fit_body([replace(SEEN, names=names)])
