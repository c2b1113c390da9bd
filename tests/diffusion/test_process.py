"""The diffusion process is exact where exactness can be computed."""

import pytest
import torch

from wearcap.diffusion.process import add_noise, posterior_step, sample
from wearcap.diffusion.schedule import CosineSchedule

SCHEDULES = [CosineSchedule(), CosineSchedule(0.1)]


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_schedule_falls_from_one_to_almost_nothing(schedule):
    alpha_bar = schedule(torch.linspace(0, 1, 101, dtype=torch.float64))
    assert alpha_bar[0] == pytest.approx(1.0, abs=1e-12)
    assert alpha_bar[-1] < 1e-4
    assert (alpha_bar.diff() < 0).all()


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_one_level_per_window_is_the_broadcast_of_one_per_frame(schedule):
    x0, noise = torch.randn(2, 5, 7), torch.randn(2, 5, 7)
    level = torch.rand(2, 1)
    whole = add_noise(x0, noise, level, schedule)
    assert torch.equal(whole, add_noise(x0, noise, level.expand(2, 5), schedule))


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_a_step_with_the_true_x0_keeps_the_marginals(schedule, eta):
    """From x_t ~ q(x_t | x0) a step lands in q(x_s | x0): mean √ᾱ_s x0 and variance 1 - ᾱ_s."""
    torch.manual_seed(0)
    x0 = torch.full((1, 200_000, 1), 1.5, dtype=torch.float64)
    level, after = torch.full((1, 1), 0.8, dtype=torch.float64), torch.full((1, 1), 0.4, dtype=torch.float64)
    x_t = add_noise(x0, torch.randn_like(x0), level, schedule)
    x_s = posterior_step(x_t, x0, level, after, torch.randn_like(x0), schedule, eta)
    alpha_bar = schedule(after).item()
    assert x_s.mean().item() == pytest.approx(1.5 * alpha_bar**0.5, abs=0.01)
    assert x_s.var().item() == pytest.approx(1 - alpha_bar, rel=0.02)


def test_posterior_is_the_papers_formula():
    """Mean and variance of thesis eq. 6.2, 6.3, written out with per-step α = ᾱ_t / ᾱ_s."""
    schedule = CosineSchedule()
    x_t, x0, noise = (torch.randn(3, 4, 2, dtype=torch.float64) for _ in range(3))
    level, after = torch.full((3, 1), 0.7, dtype=torch.float64), torch.full((3, 1), 0.65, dtype=torch.float64)
    a_t, a_s = schedule(level)[0, 0], schedule(after)[0, 0]
    alpha = a_t / a_s
    mean = a_s.sqrt() * (1 - alpha) / (1 - a_t) * x0 + alpha.sqrt() * (1 - a_s) / (1 - a_t) * x_t
    expected = mean + ((1 - a_s) * (1 - alpha) / (1 - a_t)).sqrt() * noise
    assert torch.allclose(posterior_step(x_t, x0, level, after, noise, schedule), expected, atol=1e-12)


def test_frames_whose_level_stays_are_untouched_and_clean_frames_become_x0():
    x_t, x0, noise = (torch.randn(1, 3, 2) for _ in range(3))
    level, after = torch.tensor([[0.5, 0.5, 0.0]]), torch.tensor([[0.5, 0.0, 0.0]])
    stepped = posterior_step(x_t, x0, level, after, noise, CosineSchedule())
    assert torch.equal(stepped[:, [0, 2]], x_t[:, [0, 2]])
    assert torch.allclose(stepped[:, 1], x0[:, 1], atol=1e-6)


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_sampler_is_exact_on_a_constant_field(eta):
    target = torch.randn(2, 6, 3)
    drawn = sample(lambda x, level: target, torch.randn(10, 2, 6, 3), CosineSchedule(), eta=eta)
    assert torch.allclose(drawn, target, atol=1e-5)


def test_sampler_reproduces_a_gaussian():
    """With the exact x̂0 of N(2, 0.5²), samples have that mean and spread."""
    torch.manual_seed(1)
    schedule, mean, std = CosineSchedule(), 2.0, 0.5

    def denoise(x, level):
        a = schedule(level)[..., None]
        gain = a.sqrt() * std**2 / (a * std**2 + 1 - a)
        return mean + gain * (x - a.sqrt() * mean)

    drawn = sample(denoise, torch.randn(200, 1, 20_000, 1), schedule)
    assert drawn.mean().item() == pytest.approx(mean, abs=0.02)
    assert drawn.std().item() == pytest.approx(std, rel=0.05)


def test_known_frames_come_out_as_given():
    observed = torch.randn(2, 6, 3)
    is_observed = torch.tensor([True, True, False, False, False, False]).expand(2, -1)
    drawn = sample(
        lambda x, level: torch.tanh(x),
        torch.randn(8, 2, 6, 3),
        CosineSchedule(),
        observed=observed,
        is_observed=is_observed,
    )
    assert torch.allclose(drawn[:, :2], observed[:, :2], atol=1e-6)
    assert not torch.allclose(drawn[:, 2:], observed[:, 2:], atol=0.1)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_at_level_0_there_is_no_noise_whatever_is_rounded(schedule):
    x0, noise = torch.randn(2, 5, 3), 1e6 * torch.randn(2, 5, 3)
    assert torch.equal(add_noise(x0, noise, torch.zeros(2, 1), schedule), x0)
