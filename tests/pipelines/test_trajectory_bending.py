"""Bending of paths (thesis eq. 5.1, 5.2): values by hand, derivatives, limits of the rigidity, solvers against each other."""

import functools
import math

import pytest
import torch
from hydra.utils import instantiate
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.rivals import compose
from benchmarks.rivals.bending import bend_adam, energy_terms
from wearcap.errors import WearcapError
from wearcap.optimize.losses import Loss
from wearcap.systems.ireplica.trajectory import Bending, bend, bending_problem, bent, wrapped
from wearcap.systems.ireplica.trajectory_banded import bend_banded

NOWHERE = torch.zeros(2, dtype=torch.float64)
VARIANTS = {
    "paper": Bending(30.0),
    "free start": Bending(30.0, free_start=True),
    "huber": Bending(30.0, loss=Loss("huber", 0.1)),
    "cauchy": Bending(30.0, loss=Loss("cauchy", 0.1)),
    "squares": Bending(30.0, loss=Loss("square")),
    "held": Bending(30.0, clamped_ends=True, free_start=True),
}


def randn(*shape: int, scale: float = 1.0) -> torch.Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64)


def stroll(count: int = 300, seed: int = 0, halts: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """A path with curves and halts (no step at all), at uneven times."""
    torch.manual_seed(seed)
    timestamps = torch.cat([torch.zeros(1), torch.rand(count - 1) * 0.02 + 0.02]).double().cumsum(0)
    heading = randn(count - 1, scale=0.1).cumsum(0)
    speed = 1.0 + 0.5 * torch.sin(timestamps[1:])
    if halts:
        speed[: count // 20] = 0.0
        speed[count // 2 : count // 2 + count // 10] = 0.0
    length = speed * timestamps.diff()
    steps = torch.stack([length * heading.cos(), length * heading.sin()], -1)
    return torch.cat([randn(1, 2), steps]).cumsum(0), timestamps


def drifted(path: torch.Tensor, rate: float = 0.05, turn: float = 0.4) -> torch.Tensor:
    """The path as a suit would have it: headings off by `turn` and more and more."""
    off = turn + randn(len(path) - 1, scale=rate).cumsum(0)
    step = torch.view_as_complex(path.diff(dim=0)) * torch.polar(torch.ones_like(off), off)
    return torch.cat([path[:1], path[:1] + torch.view_as_real(step).cumsum(0)])


def example(settings: Bending, seed: int = 0):
    true, timestamps = stroll(seed=seed)
    times = timestamps[0] + (timestamps[-1] - timestamps[0]) * torch.rand(80, dtype=torch.float64).sort().values
    frame = torch.searchsorted(timestamps, times).clamp(max=len(true) - 1)
    points = true[frame] + randn(80, 2, scale=0.05)
    points[20:24] += 2.0
    return bending_problem(drifted(true), timestamps, times, points, torch.rand(80), settings), true


def test_energy_by_hand():
    path = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    timestamps = torch.tensor([0.0, 1.0, 2.0, 4.0]).double()
    times, points = torch.tensor([0.5, 3.0]).double(), torch.tensor([[0.5, 1.0], [0.0, 0.0]])
    turn = torch.tensor([0.0, math.pi / 2, math.pi / 2]).double()  # right, up, up: (1, 0), (1, 1), (1, 2)
    problem = bending_problem(path, timestamps, times, points, torch.tensor([2.0, 1.0]), Bending(10))
    terms = energy_terms(problem, turn, NOWHERE)
    torch.testing.assert_close(bent(problem, turn, NOWHERE)[-1], torch.tensor([1.0, 2.0]).double())
    assert terms["control"].item() == pytest.approx(2 * 1.0 + math.hypot(1, 1.5))
    assert terms["bending"].item() == pytest.approx(10 * (math.pi / 2) ** 2)


@pytest.mark.parametrize("settings", VARIANTS.values(), ids=VARIANTS)
def test_derivative_of_the_energy(settings):
    problem, _ = example(settings)
    turn, shift = randn(len(problem.leader), scale=0.3).requires_grad_(), randn(2).requires_grad_()
    terms = energy_terms(problem, turn, shift)
    gradient = torch.autograd.grad(terms["control"] + terms["bending"], (turn, shift))
    along = randn(len(turn)), randn(2)
    step = 1e-6

    def total(share: float) -> torch.Tensor:
        with torch.no_grad():
            terms = energy_terms(problem, turn + share * along[0], shift + share * along[1])
            return terms["control"] + terms["bending"]

    slope = sum((g * a).sum() for g, a in zip(gradient, along))
    torch.testing.assert_close(slope, (total(step) - total(-step)) / (2 * step), rtol=1e-5, atol=1e-4)


def test_steps_take_the_turn_of_the_last_one_that_moves():
    path = torch.tensor([[0.0, 0], [0, 0], [0, 1], [0, 1], [0, 1], [-1, 1]]).double()
    problem = bending_problem(path, torch.arange(6).double(), torch.zeros(0).double(), path[:0], None, Bending(10.0))
    assert problem.leader.tolist() == [1, 1, 1, 1, 4]


@given(st.floats(-9, 9), st.floats(-9, 9), st.integers(-2, 2))
def test_whole_turns_do_not_count(before, after, whole):
    change = torch.tensor([after - before]).double()
    torch.testing.assert_close(wrapped(change + 2 * math.pi * whole).cos(), change.cos())
    assert wrapped(change).abs() <= math.pi + 1e-12
    assert wrapped(torch.tensor(3 * math.pi / 2)).item() == pytest.approx(-math.pi / 2, abs=1e-6)


def test_a_path_through_half_turns_is_no_bend():
    """Headings run through ±π four times; the path itself costs nothing, and turning all of it neither."""
    angle = torch.linspace(0, 8 * math.pi, 400).double()
    path, timestamps = torch.stack([angle.cos(), angle.sin()], -1), torch.arange(400).double() / 30
    step = path.diff(dim=0)
    assert torch.atan2(step[:, 1], step[:, 0]).diff().abs().amax() > 6
    problem = bending_problem(path, timestamps, timestamps[:0], path[:0], None, Bending(1000.0))
    for turn in (0.0, 3.0):
        terms = energy_terms(problem, torch.full((399,), turn).double(), NOWHERE)
        assert terms["bending"].item() < 1e-18
    half_turned = 2 * path[:1] - path
    solved = bend(path, timestamps, timestamps, half_turned, settings=Bending(1000.0), solver=bend_banded)
    assert (solved.path - half_turned).abs().amax() < 1e-6
    assert solved.history[-1]["total"] < 1e-3


@pytest.mark.parametrize("name", ["paper", "held"])
def test_ours_has_no_more_energy_than_adam(name):
    problem, _ = example(VARIANTS[name])
    ours = bend_banded(problem)
    adam = bend_adam(problem, 300, 1e-2)
    assert _least(ours) <= _least(adam) * (1 + 1e-6)
    for solved in (ours, adam):
        terms = energy_terms(problem, solved.turn, solved.path[0] - problem.path[0])
        torch.testing.assert_close(sum(t.item() for t in terms.values()), _least(solved), rtol=1e-9, atol=0.0)
        torch.testing.assert_close(bent(problem, solved.turn, solved.path[0] - problem.path[0]), solved.path)
        torch.testing.assert_close(solved.path.diff(dim=0).norm(dim=1), problem.step.norm(dim=1), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["squares", "held", "cauchy", "huber"])
def test_ours_ends_where_the_gradient_vanishes(name):
    """Against autograd: the compiled passes find a stationary point of the energy of the paper."""
    problem, _ = example(VARIANTS[name])
    solved = bend_banded(problem, iterations=200, tolerance=0.0)
    turn, shift = (solved.turn.clone().requires_grad_(), (solved.path[0] - problem.path[0]).clone().requires_grad_())
    terms = energy_terms(problem, turn, shift)
    g_turn, g_shift = torch.autograd.grad(terms["control"] + terms["bending"], (turn, shift))
    first = torch.zeros_like(turn)
    at_start = torch.autograd.grad(sum(energy_terms(problem, first.requires_grad_(), NOWHERE).values()), first)[0]
    assert g_turn.abs().amax() < 1e-3 * at_start.abs().amax()
    if problem.settings.free_start:
        assert g_shift.norm() < 1e-3 * problem.control_weights.sum()


def test_the_planted_path_is_found():
    true, timestamps = stroll(600, seed=3)
    imu = drifted(true, rate=0.02)
    assert (imu - true).norm(dim=1).mean() > 1.0
    for settings in (Bending(0.01), Bending(0.01, free_start=True)):
        solved = bend(
            imu + 5.0 * settings.free_start, timestamps, timestamps, true, settings=settings, solver=bend_banded
        )
        assert (solved.path - true).norm(dim=1).amax() < 0.01


def test_the_start_does_not_hang_on_a_first_guess():
    """Several whole turns of drift: the relaxation begins in the right place."""
    true, timestamps = stroll(3000, seed=4)
    imu = drifted(true, rate=0.15, turn=3.0)
    points = true + randn(len(true), 2, scale=0.05)
    solved = bend(imu, timestamps, timestamps, points, settings=Bending(0.1), solver=bend_banded)
    assert (solved.path - true).norm(dim=1).mean() < 0.05


def test_bursts_of_wrong_points_are_left_out_by_a_robust_loss():
    true, timestamps = stroll(1500, seed=5)
    points = true + randn(len(true), 2, scale=0.05)
    for begin in range(100, 1400, 250):
        points[begin : begin + 60] += 3 * randn(1, 2)
    solve = {
        kind: bend(
            drifted(true, 0.02), timestamps, timestamps, points, settings=Bending(1.0, loss=loss), solver=bend_banded
        )
        for kind, loss in (("norm", Loss("norm")), ("cauchy", Loss("cauchy", 0.15)))
    }
    error = {kind: (solved.path - true).norm(dim=1).mean() for kind, solved in solve.items()}
    assert error["cauchy"] < 0.03
    assert error["cauchy"] < 0.5 * error["norm"]


def test_an_infinite_rigidity_keeps_the_shape():
    """Only a turn about the start is left, and with a free start a shift: the best rigid motion."""
    path, timestamps = stroll(seed=6)
    centre, turn = path.mean(0), torch.tensor([[0.6, -0.8], [0.8, 0.6]]).double()
    points = (path - centre) @ turn.T + torch.tensor([3.0, -2.0]).double() + randn(len(path), 2, scale=0.2)
    fixed, free = (
        bend(
            path,
            timestamps,
            timestamps,
            points,
            settings=Bending(1e12, free_start=free, loss=Loss("square")),
            solver=bend_banded,
        )
        for free in (False, True)
    )
    for solved in (fixed, free):
        assert (solved.turn - solved.turn[0]).abs().amax() < 1e-6
    torch.testing.assert_close(fixed.path[0], path[0])
    a, b = torch.view_as_complex(path - centre), torch.view_as_complex(points - points.mean(0))
    best = torch.angle((a.conj() * b).sum())
    torch.testing.assert_close(free.turn[0], best, rtol=0.0, atol=1e-5)
    torch.testing.assert_close(free.path.mean(0), points.mean(0), rtol=0.0, atol=1e-5)


def test_no_rigidity_meets_the_control_points():
    path, timestamps = stroll(seed=7)
    chosen = torch.tensor([60, 130, 220, 280])
    points = path[chosen] + randn(4, 2, scale=0.1)
    off = {
        rigidity: (
            bend(path, timestamps, timestamps[chosen], points, settings=Bending(rigidity), solver=bend_banded).path[
                chosen
            ]
            - points
        )
        .norm(dim=1)
        .sum()
        for rigidity in (1e3, 1e-4)
    }
    assert off[1e-4] < 1e-3
    assert off[1e3] > 10 * off[1e-4]


@pytest.mark.parametrize("solver", [bend_banded, functools.partial(bend_adam, iterations=50)])
def test_degenerate_paths(solver):
    timestamps = torch.arange(5).double()
    still, walk = torch.ones(5, 2), torch.arange(10.0).reshape(5, 2)
    for free in (False, True):
        settings = Bending(10.0, free_start=free, clamped_ends=free)
        unheld = bend(walk, timestamps, timestamps[:0], walk[:0], settings=settings, solver=solver)
        torch.testing.assert_close(unheld.path, walk.double(), rtol=0.0, atol=1e-6)
        stands = bend(still, timestamps, timestamps[1:2], still[:1] + 3, settings=settings, solver=solver)
        assert stands.path.isfinite().all()
        assert (stands.path.diff(dim=0) == 0).all()
        pair = bend(walk[:2], timestamps[:2], timestamps[:1], walk[:1], settings=settings, solver=solver)
        assert pair.path.shape == (2, 2)
        assert pair.frame_turn.shape == (2,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": torch.full((10, 2), torch.nan)}, "path: entry 0 is not a number"),
        ({"control_points": torch.tensor([[0.0, 0.0], [torch.nan, 0.0]])}, "control points: entry 1 is not a number"),
        ({"control_times": torch.tensor([torch.nan, 2.0]).double()}, "control times: entry 0 is not a number"),
        ({"control_times": torch.tensor([3.0, 2.0]).double()}, "control point 1 .* before its predecessor"),
        ({"control_times": torch.tensor([3.0, 9.5]).double()}, "1 of 2 control points, first at 9.500 s"),
        ({"weights": torch.tensor([1.0, -1.0])}, "negative weight"),
        ({"timestamps": torch.arange(10).flip(0).double()}, "frame 1 .* before its predecessor"),
        ({"path": torch.zeros(1, 2), "timestamps": torch.zeros(1).double()}, "1 frames cannot be bent"),
    ],
)
def test_bad_input_is_refused(change, message):
    known = {
        "path": torch.rand(10, 2),
        "timestamps": torch.arange(10).double(),
        "control_times": torch.tensor([1.0, 2.0]).double(),
        "control_points": torch.zeros(2, 2),
        "weights": torch.ones(2),
    }
    with pytest.raises(WearcapError, match=message):
        bend(**(known | change), settings=Bending(10.0), solver=bend_banded)


def test_bad_settings_are_refused():
    for wrong in ({"rigidity": 0.0}, {"rigidity": math.nan}):
        with pytest.raises(WearcapError):
            Bending(**({"rigidity": 1.0} | wrong))


def _least(solved) -> float:
    return min(entry["total"] for entry in solved.history)


@pytest.mark.parametrize("choice", ["adam", "banded"])
def test_every_config_bends(choice):
    if choice == "adam":
        config = compose("capture", ["recording=none", "+bending=adam"]).bending
    else:
        config = compose("capture", ["recording=none", "pipeline=paper/bent_suit"]).pipeline.bend
    path, timestamps = stroll(60)
    imu = drifted(path)
    few = {"solver": functools.partial(bend_adam, iterations=20)} if choice == "adam" else {}
    solved = instantiate(config)(imu, timestamps, timestamps, path, **few)
    assert (solved.path - path).norm(dim=1).mean() < (imu - path).norm(dim=1).mean()
