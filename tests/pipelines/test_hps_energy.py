"""Every term of HPS: its derivative, its value by hand, and the compiled system against autograd (float64)."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from wearcap.body.anny_body import anny_body
from wearcap.body.skeleton import xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.surface import SurfaceIndex
from wearcap.optimize import losses
from wearcap.optimize.losses import Loss
from wearcap.systems.hps import costs
from wearcap.systems.hps.adam_windows import AdamSettings, solve_adam_windows
from wearcap.systems.hps.banded import BandedSettings, Stretch, solve_banded, solve_in_stretches
from wearcap.systems.hps.banded_kernels import LEGS
from wearcap.systems.hps.block_tridiagonal import factor_and_solve
from wearcap.systems.hps.energy import TERMS, FootPatches, HpsData, HpsEnergy, HpsState, SuitSteps, Term, energy_terms

MIXED = {
    "hold": Loss("cauchy", 0.05),
    "root_step": Loss("huber", 0.01),
    "head_step": Loss("square"),
    "contact_plane": Loss("square"),
}


def randn(*shape: int, scale: float = 1.0) -> torch.Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64)


@functools.cache
def patches() -> FootPatches:
    return FootPatches.of(anny_body(xsens23()))


def still_data(length: int = 8, noise: float = 0.0, seed: int = 0) -> HpsData:
    """A person who stands on the floor, every input disturbed by `noise` (rad, m)."""
    torch.manual_seed(seed)
    body = patches().body
    joints = len(body.skeleton)
    lowest = body.rest_vertices[patches().vertex, 2].min().double()
    start = HpsState(
        randn(length, joints - 1, 3, scale=noise),
        rotation.exp(randn(length, 3, scale=noise)),
        torch.stack([torch.zeros(2, dtype=torch.float64).new_tensor([0.3, -0.2, -lowest])] * length)
        + randn(length, 3, scale=noise),
    )
    floor = np.random.default_rng(seed).uniform(-1, 1, (40_000, 3)) * [1, 1, 0.0005]
    one, turns = torch.ones(length, dtype=torch.float64), rotation.exp(randn(length, 3, scale=noise))
    return HpsData(
        patches(),
        start,
        rotation.exp(randn(3, scale=0.3)),
        turns,
        one,
        one.clone(),
        torch.ones(length, 4, dtype=torch.float64),
        SuitSteps(
            randn(length - 1, 3, scale=noise),
            rotation.exp(randn(length - 1, 3, scale=noise)),
            rotation.exp(randn(length - 1, 3, scale=noise)),
        ),
        SurfaceIndex.build(floor.astype(np.float32)),
    )


def disturbed(data: HpsData, scale: float) -> HpsState:
    """A state beside the initialisation; the arms stay."""
    active = torch.zeros(data.start.theta.shape[1], 1, dtype=torch.float64)
    active[Stretch(HpsEnergy({}), data, data.start).columns] = 1
    theta, R, t = data.start.theta, data.start.R_world_root, data.start.t_world_root
    return HpsState(
        theta + active * randn(*theta.shape, scale=scale),
        R @ rotation.exp(randn(len(t), 3, scale=scale)),
        t + randn(*t.shape, scale=scale),
    )


@pytest.mark.parametrize("kind", losses.LOSSES)
def test_losses_have_true_derivatives_and_none_at_zero(kind):
    loss = Loss(kind, 0.7)
    residual = randn(6, 3).requires_grad_()
    assert torch.autograd.gradcheck(loss, (residual,))
    zero = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(zero).sum(), zero)
    assert (slope == 0).all()


def rotations(count: int) -> torch.Tensor:
    return randn(count, 3, scale=0.5)


@pytest.mark.parametrize(
    ("cost", "inputs"),
    [
        (
            lambda a, b, c: costs.head_orientation(rotation.exp(a), rotation.exp(b), rotation.exp(c)),
            lambda: (rotations(4), rotations(1)[0], rotations(4)),
        ),
        (costs.position_offset, lambda: (randn(4, 3), randn(4, 3))),
        (costs.position_offset, lambda: (randn(3, 4, 3), randn(3, 4, 3))),
        (costs.plane_distance, lambda: (randn(3, 4, 3), randn(3, 4, 3), randn(3, 4, 3))),
        (costs.position_step, lambda: (randn(4, 3), randn(3, 3))),
        (costs.position_step, lambda: (randn(3, 4, 3), randn(2, 4, 3))),
        (lambda a, b: costs.rotation_step(rotation.exp(a), rotation.exp(b)), lambda: (rotations(4), rotations(3))),
        (costs.pose_offset, lambda: (randn(4, 5, 3), randn(4, 5, 3))),
        (costs.pose_step, lambda: (randn(4, 5, 3), randn(4, 5, 3))),
    ],
)
def test_each_cost_has_the_derivative_of_autograd(cost, inputs):
    torch.manual_seed(1)
    assert torch.autograd.gradcheck(cost, tuple(value.requires_grad_() for value in inputs()))


def test_terms_are_the_means_of_the_equations():
    data = still_data(5)
    away = HpsState(
        data.start.theta,
        data.start.R_world_root @ rotation.exp(torch.tensor([0.0, 0, 0.1]).double()),
        data.start.t_world_root + torch.tensor([0.0, 0, 0.02]).double(),
    )
    data_half = still_data(5)
    data_half.contact[:, 2:] = 0.0
    terms = energy_terms(HpsEnergy(dict.fromkeys(TERMS, 2.0)), data, away)
    assert terms["hold"] == pytest.approx(2 * 0.02)
    assert terms["translation_smooth"] == pytest.approx(0.0)
    whole, half = (
        energy_terms(HpsEnergy({"contact_plane": 1.0}), d, away)["contact_plane"].item() for d in (data, data_half)
    )
    assert 0.015 < whole < 0.035
    assert half == pytest.approx(whole / 2, rel=0.2)  # divided by frames times parts, not by contacts


def test_a_wall_beside_a_gap_in_the_floor_carries_no_foot():
    data = still_data(4)
    rng = np.random.default_rng(1)
    wall = rng.uniform(-1, 1, (40_000, 3)) * [0.0005, 1, 0.5] + [0.75, 0, 0.5]
    beside_wall = replace(data, surface=SurfaceIndex.build(wall.astype(np.float32)))
    energy = HpsEnergy({"contact_plane": 1.0})
    assert energy_terms(energy, beside_wall, data.start)["contact_plane"].item() == 0.0
    assert energy_terms(energy, data, data.start)["contact_plane"].item() > 0.0


def test_the_whole_mesh_gives_the_patches_energy():
    data = still_data(4, 0.1)
    energy = HpsEnergy({"contact": 1.0, "slide": 1.0})
    whole, alone = (energy_terms(energy, data, data.start, full_mesh=full) for full in (True, False))
    assert all(whole[name] == pytest.approx(alone[name].item(), rel=1e-6) for name in whole)


@pytest.mark.parametrize("name", [*TERMS, "all"])
def test_compiled_energy_and_gradient_agree_with_autograd(name):
    data = still_data(7, 0.05)
    data.contact[2:4, 0] = data.contact[5, 3] = 0.0
    data.cam_confidence[3], data.hold_confidence[5] = 0.0, 0.5
    energy = HpsEnergy({term: 1.0 + place for place, term in enumerate(TERMS) if name in (term, "all")}, MIXED)
    state = disturbed(data, 0.05)
    stretch = Stretch(energy, data, state)
    compiled = stretch.evaluate(1e-9)
    theta, t = state.theta.clone().requires_grad_(), state.t_world_root.clone().requires_grad_()
    turn = torch.zeros_like(t).requires_grad_()
    terms = energy_terms(energy, data, HpsState(theta, state.R_world_root @ rotation.exp(turn), t))
    assert terms.keys() == compiled.keys() - {"total"}
    assert all(compiled[term] == pytest.approx(terms[term].item(), rel=1e-5) for term in terms)
    by_t, by_turn, by_theta = torch.autograd.grad(
        sum(terms.values()), [t, turn, theta], allow_unused=True, materialize_grads=True
    )
    stretch.fill_system()
    blocks, _, gradient = stretch.system
    by_theta = by_theta[:, stretch.columns].numpy()
    legs = stretch.body.leg_chains.ravel() - 1
    assert np.abs(gradient[:, :3] - by_t.numpy()).max() < 1e-5
    assert np.abs(gradient[:, 3:6] - by_turn.numpy()).max() < 1e-5
    assert np.abs(gradient[:, LEGS:] - by_theta[:, legs].reshape(len(t), -1)).max() < 1e-5
    spine = stretch.body.head_chain
    J = stretch.kin.axes[:, spine].transpose(0, 2, 1, 3).reshape(len(t), 3, -1)
    by_head = np.linalg.inv(J @ J.mT) @ J @ by_theta[:, spine - 1].reshape(len(t), -1, 1)
    assert np.abs(gradient[:, 6:9] - by_head[..., 0]).max() < 1e-5
    assert np.abs(blocks - blocks.mT).max() < 1e-9


@pytest.mark.parametrize("name", [name for name in TERMS if name != "pose"])
def test_automatic_derivatives_agree_with_the_compiled_ones(name, monkeypatch):
    data = still_data(7, 0.002)
    data.contact[2:4, 0] = data.cam_confidence[3] = data.hold_confidence[5] = 0.0
    state, energy = disturbed(data, 0.002), HpsEnergy({name: 3.0}, MIXED)
    systems = []
    for term in (TERMS[name], replace(TERMS[name], expected=())):
        monkeypatch.setitem(TERMS, name, term)
        stretch = Stretch(energy, data, state)
        systems.append([np.array(stretch.evaluate(1e-3)["total"])])
        stretch.fill_system()
        systems[-1] += [part.copy() for part in stretch.system]
    block = 0.05 if TERMS[name].inputs[0].startswith("R_") else 1e-9  # the kernels leave out half the turn's own slope
    for known, automatic, tolerance in zip(*systems, (1e-9, block, block, 1e-9)):
        assert np.abs(known - automatic).max() <= tolerance * np.abs(known).max()


def planted() -> tuple[HpsData, HpsState]:
    """A standing person who knows the steps and turns exactly, and whose localised positions are 10 % far off."""
    data = still_data(40)
    truth = data.start
    torch.manual_seed(3)
    far = torch.where(torch.rand(40, 1) < 0.1, 1.0, 0.02).double() * randn(40, 3)
    held = HpsState(truth.theta, truth.R_world_root, truth.t_world_root + far)
    exact = HpsData(
        data.patches,
        held,
        torch.eye(3, dtype=torch.float64),
        truth.R_world_root,
        data.cam_confidence,
        data.hold_confidence,
        data.contact,
        SuitSteps(
            torch.zeros(39, 3, dtype=torch.float64),
            torch.eye(3, dtype=torch.float64).expand(39, 3, 3).clone(),
            torch.eye(3, dtype=torch.float64).expand(39, 3, 3).clone(),
        ),
        data.surface,
    )
    return exact, truth


PAPER = {
    "self": 10.0,
    "contact": 300.0,
    "slide": 500.0,
    "head_smooth": 4.0,
    "root_smooth": 4.0,
    "pose": 20.0,
    "hold": 30.0,
    "translation_step": 800.0,
}


def test_the_banded_solver_finds_a_planted_motion():
    data, truth = planted()
    weights = {"self": 10.0, "slide": 500.0, "pose": 20.0, "hold": 30.0, "translation_step": 800.0, "root_step": 400.0}
    torch.manual_seed(4)
    begin = disturbed(data, 0.05)
    solution = solve_banded(HpsEnergy(weights), data, BandedSettings(iterations=30, relaxation=1.5), begin)
    away = (solution.state.t_world_root - truth.t_world_root).norm(dim=1)
    assert away.max() < 0.02  # the median of positions that are 2 cm off, and each tenth 1 m
    assert rotation.geodesic(solution.state.R_world_root, truth.R_world_root).max() < 0.003
    assert (solution.state.theta - truth.theta).abs().max() < 0.003


BEACON = torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64)


def beacon_distance(t_world_root: torch.Tensor) -> torch.Tensor:
    """Toy cost of one frame: distance (m) of the root from a beacon that measures 1.5 m."""
    return (t_world_root - BEACON).norm(dim=-1, keepdim=True) - 1.5


def gaze_step(R_world_head: torch.Tensor, t_world_root: torch.Tensor) -> torch.Tensor:
    """Toy cost of two frames: speed of the point 1 m in front of the head's orientation from frame to frame."""
    return (t_world_root + R_world_head[:, :, 0]).diff(dim=0)


@pytest.mark.parametrize(
    ("solve", "off_m", "away_m"),
    [
        (functools.partial(solve_banded, settings=BandedSettings(iterations=20, relaxation=1.5)), 5e-3, 0.04),
        (
            lambda e, d: solve_adam_windows(e, d, AdamSettings(steps=250, learning_rate=3e-3, full_mesh=False)),
            0.05,
            0.3,
        ),
    ],
    ids=["banded", "adam"],
)
def test_a_term_that_is_added_to_the_table_finds_its_planted_answer(solve, off_m, away_m, monkeypatch):
    monkeypatch.setitem(TERMS, "beacon", Term(beacon_distance, ("t_root",), reach=1))
    monkeypatch.setitem(TERMS, "gaze", Term(gaze_step, ("R_head", "t_root"), reach=2))
    data = still_data(12, 0.01)
    weights = {"self": 10.0, "pose": 20.0, "hold": 5.0, "root_step": 40.0, "beacon": 1e4, "gaze": 1e4}
    energy = HpsEnergy(weights, {"beacon": Loss("square"), "gaze": Loss("square"), "hold": Loss("square")})
    solution = solve(energy, data)
    t = solution.state.t_world_root
    assert (t - BEACON).norm(dim=1) == pytest.approx(torch.full((12,), 1.5), abs=off_m)
    nearest = BEACON + 1.5 * torch.nn.functional.normalize(data.start.t_world_root.mean(0) - BEACON, dim=0)
    assert (t - nearest).norm(dim=1).max() < away_m  # `hold` leaves it where the start is nearest to the sphere
    assert solution.history[-1]["gaze"] < 0.1 * solution.history[0]["gaze"]


def test_a_term_that_is_added_is_solved_in_parallel_stretches(monkeypatch):
    monkeypatch.setitem(TERMS, "beacon", Term(beacon_distance, ("t_root",), reach=1))
    data, energy = still_data(40, 0.01), HpsEnergy({"self": 10.0, "pose": 20.0, "hold": 5.0, "beacon": 10.0})
    one, two = (solve_in_stretches(energy, data, stretch=5, overlap=4, jobs=jobs).state for jobs in (1, 4))
    assert torch.equal(one.t_world_root, two.t_world_root)


def test_the_banded_solver_refuses_a_new_term_of_the_spine(monkeypatch):
    monkeypatch.setitem(TERMS, "stiff", Term(lambda theta: theta.flatten(1), ("theta",), reach=1))
    with pytest.raises(WearcapError, match="cannot minimise the term 'stiff'"):
        solve_banded(HpsEnergy({"pose": 1.0, "hold": 1.0, "stiff": 1.0}), still_data(4))


def test_the_banded_solver_goes_no_less_low_than_adam():
    data, _ = planted()
    energy = HpsEnergy(PAPER)
    ours = solve_banded(energy, data, BandedSettings(iterations=20, relaxation=1.5))
    adam = solve_adam_windows(energy, data, AdamSettings(steps=40, full_mesh=False))
    true = [sum(energy_terms(energy, data, s.state).values()).item() for s in (ours, adam)]
    assert true[0] <= true[1]


def test_adam_keeps_the_frame_that_windows_share():
    data, _ = planted()
    settings = AdamSettings(window=15, advance=14, steps=5, full_mesh=False)
    solution = solve_adam_windows(HpsEnergy(PAPER), data, settings)
    assert (len(solution.state), len(solution.history)) == (40, 5)
    alone = solve_adam_windows(HpsEnergy(PAPER), data[:15], settings).state
    assert torch.equal(solution.state.t_world_root[:15], alone.t_world_root)
    assert torch.equal(solution.state.theta[:15], alone.theta)
    assert (solution.state.t_world_root[15] - data.start.t_world_root[15]).abs().max() > 1e-4


def test_stretches_join_to_the_whole(monkeypatch):
    data, _ = planted()
    data.hold_confidence[9:13] = 0.0  # where a border would lie
    energy = HpsEnergy(PAPER | {"root_step": 400.0})
    settings = BandedSettings(iterations=12, relaxation=1.5)
    whole = solve_banded(energy, data, settings).state
    solved = []

    def noted(energy, stretch, settings):
        solved.append(len(stretch))
        return solve_banded(energy, stretch, settings)

    monkeypatch.setattr("wearcap.systems.hps.banded.solve_banded", noted)
    joined = solve_in_stretches(energy, data, settings, stretch=10, overlap=8, jobs=1)
    assert len(joined.state) == len(data)
    assert (joined.state.t_world_root - whole.t_world_root).norm(dim=1).max() < 0.02
    # Kept are the frames 0-12, 13-22, 23-32 and 33-39, solved are 0-20, 1-30, 15-39 and 25-39.
    assert solved == [21, 30, 25, 15]


def test_an_energy_that_leaves_something_open_is_refused():
    data = still_data(4)
    with pytest.raises(WearcapError, match="does not determine"):
        solve_banded(HpsEnergy({"slide": 1.0}), data)
    with pytest.raises(WearcapError, match="no term 'slid'"):
        HpsEnergy({"slid": 1.0})


def test_elimination_solves_blocks_of_which_some_unknowns_are_not_coupled():
    """A foot in the air is not coupled to the next frame; another one is when it lands."""
    rng, (count, n) = np.random.default_rng(0), (6, 9)
    root = rng.normal(size=(count, n, n))
    diagonal, below = root @ root.transpose(0, 2, 1) + 20 * np.eye(n), rng.normal(size=(count - 1, n, n))
    below[0, 3:6], below[1, 6:], below[2] = 0.0, 0.0, 0.0
    whole = np.zeros((count, n, count, n))
    for j in range(count):
        whole[j, :, j] = diagonal[j]
        if j + 1 < count:
            whole[j + 1, :, j], whole[j, :, j + 1] = below[j], below[j].T
    right = rng.normal(size=(count, n))
    expected = np.linalg.solve(whole.reshape(count * n, -1), right.ravel()).reshape(count, n)
    factor_and_solve(diagonal, below, right, 0.0)
    np.testing.assert_allclose(right, expected, atol=1e-10)
