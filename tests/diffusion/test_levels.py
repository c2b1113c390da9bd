"""Levels as training draws them: in range, in the shares that are asked for, growing along a conveyor."""

import pytest
import torch

from wearcap.diffusion.levels import DRAWS, LevelMix
from wearcap.errors import WearcapError

SHAPE = (4000, 20, 3)


def drawn(**shares) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    frames = torch.rand(*SHAPE[:2], SHAPE[2] + 1, generator=random)
    draws = torch.rand(SHAPE[0], DRAWS, generator=random)
    return LevelMix(**{"independent": 0.25, "conveyor": 0.6, "observed": 0.15} | shares).levels(frames, draws), frames[
        ..., :-1
    ]


def test_levels_are_of_every_frame_and_modality_and_within_their_range():
    levels, _ = drawn()
    assert levels.shape == SHAPE
    assert levels.min() >= 0
    assert levels.max() <= 1


def test_independent_levels_are_those_of_the_frames():
    levels, frames = drawn(independent=1.0, conveyor=0.0, observed=0.0)
    assert torch.equal(levels, frames)


def test_a_share_of_the_windows_is_pure_noise():
    levels, _ = drawn(independent=0.1, conveyor=0.3, observed=0.0, pure=0.5)
    pure = (levels == 1).all(-1).all(-1).float().mean().item()
    assert pure == pytest.approx(0.5, abs=0.03)


def test_pure_noise_has_observed_frames_too():
    levels, _ = drawn(independent=0.0, conveyor=0.0, observed=1.0, pure=1.0)
    assert set(levels.unique().tolist()) == {0.0, 1.0}


def test_a_conveyors_levels_grow_and_are_alike_for_all_modalities():
    levels, _ = drawn(independent=0.0, conveyor=1.0, observed=0.0)
    assert (levels.diff(dim=1) >= 0).all()
    assert (levels == levels[..., :1]).all()
    assert (levels[:, 0] > 0.5).any(), "a queue that fills"
    assert (levels[:, -1] < 0.5).any(), "a queue that empties"


def test_a_conveyors_slope_is_that_of_a_ramp_that_is_asked_for():
    levels, _ = drawn(independent=0.0, conveyor=1.0, observed=0.0, ramp=[10, 14])
    steps = levels.diff(dim=1)
    inside = steps[(levels[:, 1:] < 1) & (levels[:, :-1] > 0)]
    assert inside.min() >= 1 / 14 - 1e-5
    assert inside.max() <= 1 / 10 + 1e-5


def test_else_each_modality_has_one_level_of_its_own():
    levels, _ = drawn(independent=0.0, conveyor=0.0, observed=0.0)
    assert (levels == levels[:, :1]).all()
    assert levels[:, 0].mT.corrcoef().fill_diagonal_(0).abs().max() < 0.1


def test_windows_are_dealt_out_in_the_shares_that_are_asked_for():
    levels, frames = drawn(independent=0.2, conveyor=0.5, observed=0.0)
    single = (levels == levels[:, :1]).all(1).all(1)
    independent = (levels == frames).all(1).all(1)
    grows = (levels == levels[..., :1]).all(-1).all(-1) & ~single
    assert independent.float().mean() == pytest.approx(0.2, abs=0.03)
    assert grows.float().mean() == pytest.approx(0.5, abs=0.05)  # some are flat within the window
    assert (single & ~independent).float().mean() == pytest.approx(0.3, abs=0.05)


def test_observed_frames_are_of_one_modality_at_a_time():
    levels, _ = drawn(independent=1.0, conveyor=0.0, observed=0.4)
    touched = (levels == 0).any(1)
    assert touched.sum(-1).max() == 1
    share = touched.float().mean(0)
    assert (share > 0.07).all()
    assert share.sum() < 0.4


def test_what_is_observed_does_not_change_the_other_modalities_levels():
    levels, _ = drawn(independent=1.0, conveyor=0.0, observed=1.0)
    for modality in range(3):
        observed_parts = levels[..., modality] == 0
        other = levels[..., (modality - 1) % 3][observed_parts]
        assert other.mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("whole", [0.0, 0.4])
def test_as_many_windows_as_asked_for_are_known_whole(whole):
    levels, _ = drawn(independent=1.0, conveyor=0.0, observed=1.0, fully_observed=whole)
    observed_parts = (levels == 0).all(1).any(-1).float().mean()
    assert observed_parts == pytest.approx(whole, abs=0.04)
    some = (levels == 0).any(1).any(-1).float().mean()
    assert some > whole + 0.3, "others are known in part"


@pytest.mark.parametrize(
    "wrong",
    [
        {"lead": [0.0, 0.0, 1.0]},
        {"chances": [1.0, -1.0, 1.0]},
        {"fully_observed": 1.0},
        {"ramp": [20, 10]},
        {"ramp": [0, 5]},
        {"independent": 0.7, "conveyor": 0.6},
        {"pure": 0.2},
        {"pure": -0.1},
    ],
)
def test_shares_and_ramps_that_cannot_be_are_refused(wrong):
    with pytest.raises(WearcapError, match="Expected shares that add up"):
        LevelMix(**{"independent": 0.25, "conveyor": 0.6, "observed": 0.15} | wrong)


def test_a_modality_in_the_lead_is_denoised_first():
    levels, _ = drawn(independent=0.0, conveyor=1.0, observed=0.0, lead=[0.0, 0.0, 0.5], ramp=[10, 10])
    human, scene_object, contact = levels.unbind(-1)
    assert torch.equal(human, scene_object)
    assert (contact <= human).all()
    inside = (human > 0) & (human < 1)
    assert ((contact < human - 0.1) & inside).float().mean() > 0.1
    first = (human >= 1).float().argmax(1)
    newest = (human.amax(1) >= 1) & (first > 0)
    assert (contact[newest, first[newest]] == 1).all(), "all enter as noise"
    slopes = contact.diff(dim=1)[(contact[:, 1:] < 1) & (contact[:, :-1] > 0)]
    assert slopes.min() >= 1 / 10 - 1e-5
    assert slopes.max() <= 1 / 5 + 1e-5


def test_the_observed_modality_is_drawn_by_its_chance():
    levels, _ = drawn(independent=1.0, conveyor=0.0, observed=1.0, fully_observed=0.99, chances=[1.0, 0.0, 3.0])
    share = (levels == 0).any(1).float().mean(0)
    assert share[1] == 0
    assert (share[2] / share[0]).item() == pytest.approx(3.0, rel=0.15)
