"""Moving the wearer onto what is touched: the offset against a dense solve, its shape, the paper's bending."""

import functools
import math

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.systems.ireplica.contact_correction import OffsetSettings, bend_contacts, offset_for
from wearcap.systems.ireplica.trajectory import Bending, bend
from wearcap.systems.ireplica.trajectory_banded import bend_banded

FPS = 60
BEND = functools.partial(bend, settings=Bending(0.003, clamped_ends=True), solver=bend_banded)


def times(count: int) -> torch.Tensor:
    return torch.arange(count).double() / FPS


def contact(count: int, first: int, last: int, target=(0.1, -0.05)) -> tuple[torch.Tensor, torch.Tensor]:
    weights = torch.zeros(count)
    weights[first : last + 1] = 1.0
    return torch.tensor(target).expand(count, 2), weights


def added_speed(offset: torch.Tensor, timestamps: torch.Tensor) -> torch.Tensor:
    """Speed (m/s) that an offset adds to the root, and to feet that stand."""
    return offset.diff(dim=0).norm(dim=1) / timestamps.diff()


def energy(offset, targets, weights, timestamps, settings) -> torch.Tensor:
    """What the offset minimises, written out."""
    before, after = timestamps.diff()[:-1, None], timestamps.diff()[1:, None]
    around = (before + after) / 2
    bend = (offset.diff(dim=0)[1:] / after - offset.diff(dim=0)[:-1] / before) / around
    span = torch.cat([timestamps.diff()[:1], around[:, 0], timestamps.diff()[-1:]])[:, None]
    pull = settings.hold * weights.double()[:, None]
    data = (pull * (offset - targets) ** 2).sum() + (span * (weights == 0)[:, None] * offset**2).sum()
    return data + settings.stiffness * (around * bend**2).sum()


def test_the_offset_is_the_minimum_of_its_energy():
    """Against autograd, at uneven times, in three coordinates: the gradient vanishes (a square: there is one)."""
    torch.manual_seed(0)
    timestamps = torch.cat([torch.zeros(1), torch.rand(199) * 0.02 + 0.01]).double().cumsum(0)
    targets, weights = torch.randn(200, 3, dtype=torch.float64), (torch.rand(200) > 0.8) * torch.rand(200)
    settings = OffsetSettings(0.7, 30.0)
    offset = offset_for(targets, weights, timestamps, settings).requires_grad_()
    value = energy(offset, targets, weights, timestamps, settings)
    gradient = torch.autograd.grad(value, offset)[0]
    assert gradient.abs().amax() < 1e-7 * value
    nothing = energy(torch.zeros(200, 3).double(), targets, weights, timestamps, settings)
    assert value < nothing


@pytest.mark.parametrize(("first", "last"), [(600, 600), (600, 780)])
@pytest.mark.parametrize("transition_s", [1.0, 2.0])
def test_the_offset_grows_and_fades_in_the_time_that_is_set(first, last, transition_s):
    """Met in the contact; 5 % of it `transition_s` before and after; a swing and an added speed as documented."""
    targets, weights = contact(1400, first, last)
    settings = OffsetSettings(transition_s)
    offset = offset_for(targets, weights, times(1400), settings)
    size, full = offset.norm(dim=1), targets[0].norm().item()
    held = weights > 0
    assert (offset - targets)[held].norm(dim=1).amax() < 0.005 * full
    step = round(transition_s * FPS)
    for edge in (size[first - step], size[last + step]):
        assert 0.03 * full < edge < 0.0505 * full
    assert (size[: first - step].amax(), size[last + step :].amax()) <= (0.0505 * full, 0.0505 * full)
    assert (offset @ targets[0].double()).amin() > -0.045 * full**2
    speed = added_speed(offset, times(1400))
    assert speed.amax().item() == pytest.approx(1.34 * full / transition_s, rel=0.02)
    assert size[:100].amax() < 1e-3 * full


def test_a_hand_on_an_arc_is_followed_in_every_frame():
    """A target that moves with the door."""
    count = 600
    timestamps, angle = times(count), torch.linspace(0, math.pi / 2, 240).double()
    wanted, weights = torch.zeros(count, 2).double(), torch.zeros(count)
    wanted[180:420], weights[180:420] = 0.8 * torch.stack([angle.cos(), angle.sin()], -1), 1.0
    hand = wanted + 0.08 * torch.stack([torch.sin(timestamps), torch.cos(timestamps)], -1)
    offset = offset_for(wanted - hand, weights, timestamps)
    assert (hand + offset - wanted)[180:420].norm(dim=1).amax() < 0.002


def test_an_offset_that_nothing_asks_for_is_zero():
    for count in (1, 2, 3, 50):
        targets = torch.full((count, 2), torch.nan)
        assert (offset_for(targets, torch.zeros(count), times(count)) == 0).all()


def test_bad_targets_are_refused():
    targets, weights = contact(20, 5, 8)
    broken = targets.clone()
    broken[6, 0] = torch.nan
    with pytest.raises(WearcapError, match="frame 6"):
        offset_for(broken, weights, times(20))
    with pytest.raises(WearcapError, match="negative weight"):
        offset_for(targets, -weights, times(20))
    with pytest.raises(WearcapError, match="before its predecessor"):
        offset_for(targets, weights, times(20).flip(0))
    for wrong in ({"transition_s": 0.0}, {"hold": -1.0}):
        with pytest.raises(WearcapError):
            OffsetSettings(**wrong)


def walk(count: int = 1200) -> torch.Tensor:
    """A walk in wide curves (m)."""
    heading = 0.8 * torch.sin(times(count))
    step = torch.stack([heading.cos(), heading.sin()], -1) / FPS
    return step.cumsum(0)


def beside(path: torch.Tensor, size: float) -> torch.Tensor:
    """Targets at right angles to the path (m), where bending reaches."""
    along = torch.nn.functional.normalize(path.diff(dim=0, append=2 * path[-1:] - path[-2:-1]), dim=1)
    return size * torch.stack([-along[:, 1], along[:, 0]], -1)


def test_bending_to_contacts_meets_their_first_frame_and_keeps_the_rest():
    path, timestamps = walk(), times(1200)
    targets, weights = beside(path, 0.07), contact(1200, 300, 330)[1]
    targets[500:] *= -0.5
    weights[700:720] = 1.0
    offset = bend_contacts(targets, weights, timestamps, path, bend=BEND, transition_s=1.5)
    for start in (300, 700):
        torch.testing.assert_close(offset[start], targets[start], rtol=0.0, atol=2e-3)
    assert offset[: 300 - 90].abs().amax() == 0
    assert offset[422:608].abs().amax() < 1e-9
    assert offset[812:].abs().amax() < 1e-9
    assert added_speed(offset, timestamps).amax() < 0.5
    new = (path + offset).diff(dim=0).norm(dim=1)
    assert (new - path.diff(dim=0).norm(dim=1)).abs().amax() < 1e-4


def test_a_point_straight_ahead_is_out_of_bending_s_reach_but_not_of_the_offset_s():
    timestamps = times(600)
    path = torch.stack([timestamps, 0 * timestamps], -1)
    targets, weights = contact(600, 300, 360, (0.1, 0.0))
    bent = bend_contacts(targets, weights, timestamps, path, bend=BEND, transition_s=1.5)
    assert bent[300].norm() < 0.02
    assert bent[:200].abs().amax() < 1e-9
    assert bent[455:].abs().amax() < 1e-9
    assert (offset_for(targets, weights, timestamps)[300] - targets[300]).norm() < 1e-3


def test_contacts_close_to_each_other_and_to_the_ends():
    path, timestamps = walk(400), times(400)
    weights = torch.zeros(400)
    weights[[0, 120, 121, 240, 399]] = 1.0
    targets = beside(path, 0.03)
    offset = bend_contacts(targets, weights, timestamps, path, bend=BEND)
    assert offset.isfinite().all()
    for start in (120, 240):
        assert (offset[start] - targets[start]).norm() < 1e-3
    whole = offset_for(targets, weights, timestamps)
    assert (whole - targets)[weights > 0].norm(dim=1).amax() < 1e-3
    assert bend_contacts(targets, 0 * weights, timestamps, path, bend=BEND).abs().amax() == 0
