"""A conveyor is exact where exactness can be computed, whatever levels stand side by side on it."""

from dataclasses import replace

import pytest
import torch

from wearcap.diffusion.conveyor import Conveyor, Observation, RollingSchedule
from wearcap.diffusion.process import add_noise, posterior_step
from wearcap.diffusion.schedule import CosineSchedule
from wearcap.errors import WearcapError

SIZES = (2, 3)
SCHEDULE = CosineSchedule()
BELT = RollingSchedule(window=6, context=2, per_frame=3)


def free(items: int, frames: int, sizes=SIZES) -> Observation:
    """Nothing is known, everything is there."""
    none = torch.zeros(items, frames, len(sizes), dtype=torch.bool)
    return Observation(torch.zeros(items, frames, sum(sizes)), none, none)


def run(conveyor: Conveyor, count: int, denoise, observation=None, random=None):
    """Pushes frames; yields the number of the oldest one and what is on the conveyor after each."""
    items, per_frame = len(conveyor.x), conveyor.rolling.per_frame
    random = random or torch.Generator().manual_seed(1)
    for frame in range(count):
        conveyor.push(torch.randn(items, sum(conveyor.sizes), generator=random))
        first, frames = frame + 1 - len(conveyor.age), len(conveyor.age)
        noise = torch.randn(per_frame, *conveyor.x.shape, generator=random)
        part = observation(first, frames) if observation else free(items, frames, conveyor.sizes)
        conveyor.run(lambda x, level, first=first: denoise(x, level, first), part, noise)
        yield first, conveyor


@pytest.mark.parametrize(
    "change", [{"context": 6}, {"context": -1}, {"per_frame": 0}, {"step": "jump"}, {"lead": (0.0, 1.0)}]
)
def test_a_belt_that_cannot_run_is_refused(change):
    with pytest.raises(WearcapError, match=r"Expected"):
        replace(BELT, **change)


def test_a_belt_counts_what_is_on_it():
    assert BELT.ramp == 4
    assert BELT.steps == 12
    levels = BELT.levels(torch.arange(14))[:, 0]
    assert levels[0] == 1
    assert (levels[12:] == 0).all()
    assert (levels[:13].diff() < 0).all()
    assert (replace(BELT, spacing=2.0).levels(torch.arange(1, 12))[:, 0] < levels[1:12]).all()


def test_a_modality_in_the_lead_is_clean_first():
    """A half as long ramp: both enter as noise, and the leading one is final when the other is half way."""
    belt = replace(BELT, lead=(0.0, 0.5))
    levels = belt.levels(torch.arange(13))
    assert torch.equal(levels[:, 0], BELT.levels(torch.arange(13))[:, 0])
    assert torch.equal(levels[:7, 1], BELT.levels(torch.arange(0, 13, 2))[:, 0])
    assert (levels[6:, 1] == 0).all()
    seen = []
    conveyor = Conveyor(belt, SCHEDULE, SIZES, 2)
    for _, now in run(conveyor, 9, lambda x, level, first: seen.append(level) or torch.full_like(x, 1.5)):
        assert torch.equal(now.level, belt.levels(now.age).expand_as(now.level))
    assert (seen[-1][..., 1] <= seen[-1][..., 0]).all()
    assert torch.equal(now.x[:, : now.clean], torch.full_like(now.x[:, : now.clean], 1.5))


@pytest.mark.parametrize("levels_of", ["modality", "one"])
def test_a_level_per_frame_and_feature_is_one_per_frame_for_each_modality(levels_of):
    random = torch.Generator().manual_seed(0)
    x0, x_t, noise = (torch.randn(2, 7, 5, generator=random) for _ in range(3))
    level = torch.rand(2, 7, 2, generator=random) if levels_of == "modality" else torch.rand(2, 7, 1).expand(-1, -1, 2)
    after = level * torch.rand(2, 7, 1, generator=random)
    wide = Conveyor(BELT, SCHEDULE, SIZES, 2).wide
    noised = add_noise(x0, noise, wide(level), SCHEDULE)
    stepped = posterior_step(x_t, x0, wide(level), wide(after), noise, SCHEDULE)
    for k, part in enumerate((slice(0, 2), slice(2, 5))):
        own = add_noise(x0[..., part], noise[..., part], level[..., k], SCHEDULE)
        assert torch.equal(noised[..., part], own)
        own = posterior_step(x_t[..., part], x0[..., part], level[..., k], after[..., k], noise[..., part], SCHEDULE)
        assert torch.equal(stepped[..., part], own)


@pytest.mark.parametrize("how", [{}, {"eta": 0.0}, {"step": "redraw"}, {"spacing": 2.0}, {"context": 0}])
def test_every_frame_leaves_as_a_perfect_denoiser_predicts(how):
    truth = torch.randn(2, 20, 5)
    conveyor = Conveyor(replace(BELT, **how), SCHEDULE, SIZES, 2)
    ramp, given = conveyor.rolling.ramp, 0
    for first, now in run(conveyor, 20, lambda x, level, first: truth[:, first : first + x.shape[1]]):
        assert now.clean == max(0, first + len(now.age) - ramp + 1 - first)
        torch.testing.assert_close(now.x[:, : now.clean], truth[:, first : first + now.clean])
        given += now.clean > 0
    assert given == 20 - ramp + 1


@pytest.mark.parametrize("step", ["posterior", "redraw"])
def test_frames_on_their_way_have_their_levels_marginals(step):
    """With the true x0 a frame at level l is N(√ᾱ x0, 1 - ᾱ), in both ways to step."""
    conveyor = Conveyor(replace(BELT, step=step), SCHEDULE, (1,), 20_000)
    *_, (_, now) = run(conveyor, 9, lambda x, level, first: torch.full_like(x, 1.5))
    alpha_bar = SCHEDULE(now.rolling.levels(now.age)[:, 0])
    torch.testing.assert_close(now.x.mean(0)[:, 0], 1.5 * alpha_bar.sqrt(), atol=0.03, rtol=0)
    torch.testing.assert_close(now.x.var(0)[:, 0], 1 - alpha_bar, atol=0.03, rtol=0)


def gaussian(rho: float, std: float, mean: float):
    """E[x0 | x_t] of a stationary first-order process, exactly, of frames with any levels."""

    def denoise(x, level, first):
        place = torch.arange(x.shape[1])
        prior = std**2 * rho ** (place[:, None] - place).abs()
        a = SCHEDULE(level[0, :, 0])
        seen = a.sqrt()[:, None] * prior * a.sqrt() + (1 - a).diag() + 1e-9 * torch.eye(len(a))
        gain = prior * a.sqrt() @ torch.linalg.inv(seen)
        return mean + ((x[..., 0] - a.sqrt() * mean) @ gain.mT)[..., None]

    return denoise


def test_a_gaussian_process_comes_out_as_it_is_with_neighbours_at_other_levels():
    """Mean, deviation, and what neighbours have in common: the conditional of each frame on clean and noisy ones."""
    rho, std, mean = 0.8, 0.5, 2.0
    conveyor = Conveyor(RollingSchedule(6, 2, per_frame=40), SCHEDULE, (1,), 4000)
    *_, (_, now) = run(conveyor, 12, gaussian(rho, std, mean))
    pair = now.x[:, now.clean - 2 : now.clean, 0].mT.double()
    assert pair.mean().item() == pytest.approx(mean, abs=0.03)
    assert pair.std(1).mean().item() == pytest.approx(std, rel=0.05)
    assert pair.corrcoef()[0, 1].item() == pytest.approx(rho, abs=0.04)
    noisy = now.x[:, -2, 0]
    a = SCHEDULE(now.rolling.levels(now.age)[:, 0])[-2].item()
    assert noisy.mean().item() == pytest.approx(mean * a**0.5, abs=0.04)
    assert noisy.var().item() == pytest.approx(a * std**2 + 1 - a, rel=0.08)


def test_steps_one_by_one_are_as_all_at_once():
    noise = torch.randn(4, 2, 1, 5)
    one, many = (Conveyor(replace(BELT, per_frame=4), SCHEDULE, SIZES, 2) for _ in range(2))
    for conveyor in (one, many):
        conveyor.push(torch.ones(2, 5))
    many.run(lambda x, level: torch.tanh(x), free(2, 1), noise)
    for step in noise:
        one.run(lambda x, level: torch.tanh(x), free(2, 1), step[None])
    assert torch.equal(one.x, many.x)
    assert torch.equal(one.age, many.age)


def test_a_long_run_needs_no_more_than_a_short_one():
    conveyor = Conveyor(BELT, SCHEDULE, SIZES, 1)
    seen = {tuple(now.x.shape) for _, now in run(conveyor, 50, lambda x, level, first: torch.tanh(x))}
    assert max(shape[1] for shape in seen) == BELT.window
    assert conveyor.x.untyped_storage().nbytes() <= 4 * 5 * BELT.window
    assert len(conveyor.age) == BELT.window


@pytest.mark.parametrize("step", ["posterior", "redraw"])
def test_what_is_known_stays_at_level_0_and_what_is_absent_stays_noise(step):
    conveyor = Conveyor(replace(BELT, step=step), SCHEDULE, SIZES, 1)
    seen = []

    def observation(first, frames):
        observed = torch.zeros(1, frames, 2, dtype=torch.bool)
        observed[..., 0] = (torch.arange(first, first + frames) % 2 == 0)[None]
        absent = torch.zeros_like(observed)
        absent[..., 1] = True
        return Observation(torch.full((1, frames, 5), 7.0), observed, absent)

    def denoise(x, level, first):
        seen.append((x, level, first))
        return torch.zeros_like(x)

    noise = {}
    for first, now in run(conveyor, 9, denoise, observation):
        for k in range(len(now.age)):
            noise.setdefault(first + k, now.x[0, k, 2:])
            assert torch.equal(now.x[0, k, 2:], noise[first + k]), "absent: as it entered"
            if (first + k) % 2 == 0:
                assert (now.x[0, k, :2] == 7).all()
    for x, level, first in seen:
        even = torch.arange(first, first + x.shape[1]) % 2 == 0
        assert (level[0, even, 0] == 0).all()
        assert (level[0, :, 1] == 1).all()
        assert (x[0, even, :2] == 7).all()


def test_every_prediction_may_be_guided():
    conveyor = Conveyor(BELT, SCHEDULE, SIZES, 1)
    conveyor.push(torch.zeros(1, 5))
    for _ in range(BELT.ramp):
        conveyor.run(lambda x, level: torch.zeros_like(x), free(1, 1), torch.zeros(3, 1, 1, 5), lambda x0: x0 + 2.0)
    torch.testing.assert_close(conveyor.x, torch.full((1, 1, 5), 2.0))
