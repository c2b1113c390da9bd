"""The floor that feet stand on: D.2's rules one by one, and ours on slopes, stairs and beside them."""

import pytest
import torch

from wearcap.scene.floor import FloorFixed, FloorFollow, FloorFollower, FloorUpdate

SOLE = 0.02


def stand(count: int, height: float, left: float = 1.0, right: float = 1.0):
    """Frames of both feet at a height; probabilities of contact."""
    feet = torch.tensor([[0.0, 0.1, height], [0.0, -0.1, height]]).expand(count, 2, 3)
    return torch.tensor([left, right]).expand(count, 2), feet


def level(follower: FloorFollower) -> float:
    return follower.ahead(torch.tensor([[0.0, 0.0, 1.6]]))[0].item()


def points_at(height: float, count: int = 40) -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    spread = 0.2 * torch.rand(count, 3, generator=random) - 0.1
    return spread * torch.tensor([1.0, 1.0, 0.05]) + torch.tensor([0.0, 0.1, height])


def test_one_foot_on_a_step_moves_the_floor_to_the_foot_where_points_are_few():
    follower = FloorUpdate(0.0)
    follower.follow(*stand(12, 0.3, right=0.0))
    assert level(follower) == pytest.approx(0.3)


def test_enough_points_near_the_foot_take_its_place():
    follower = FloorUpdate(0.0)
    follower.see(points_at(0.25))
    follower.follow(*stand(12, 0.3, right=0.0))
    assert level(follower) == pytest.approx(0.25, abs=0.01)
    few = FloorUpdate(0.0)
    few.see(points_at(0.25, count=9))
    few.follow(*stand(12, 0.3, right=0.0))
    assert level(few) == pytest.approx(0.3)


def test_changes_below_ten_centimetres_are_none():
    follower = FloorUpdate(0.0)
    follower.follow(*stand(40, 0.09, right=0.0))
    assert level(follower) == 0.0


def test_both_feet_at_rest_change_nothing():
    follower = FloorUpdate(0.0)
    follower.follow(*stand(60, 0.3))
    # The first five frames have not stood for five frames before them.
    assert level(follower) == pytest.approx(0.3)
    settled = FloorUpdate(0.0)
    settled.follow(*stand(20, 0.0))
    settled.follow(*stand(60, 0.3))
    assert level(settled) == 0.0


def test_updates_are_25_frames_apart():
    follower = FloorUpdate(0.0)
    follower.follow(*stand(12, 0.3, right=0.0))
    follower.follow(*stand(18, 0.6, right=0.0))
    assert level(follower) == pytest.approx(0.3)
    follower.follow(*stand(12, 0.6, right=0.0))
    assert level(follower) == pytest.approx(0.6)


def test_contact_needs_more_than_half_a_chance():
    follower = FloorUpdate(0.0)
    follower.follow(*stand(40, 0.3, left=0.5, right=0.2))
    assert level(follower) == 0.0


def test_the_latest_contact_counts_while_none_is_made():
    follower = FloorUpdate(0.0)
    follower.follow(*stand(8, 0.3, right=0.0))
    follower.follow(*stand(30, 0.9, left=0.0, right=0.0))
    assert level(follower) == pytest.approx(0.3)


@pytest.mark.parametrize("pieces", [1, 3, 7])
def test_frames_may_come_in_pieces_of_any_length(pieces):
    random = torch.Generator().manual_seed(1)
    contact = torch.rand(200, 2, generator=random)
    feet = torch.rand(200, 2, 3, generator=random).cumsum(0) * 0.05
    whole, cut = FloorUpdate(0.0), FloorUpdate(0.0)
    whole.follow(contact, feet)
    for some in torch.arange(200).chunk(pieces):
        cut.follow(contact[some], feet[some])
    assert level(cut) == level(whole)


def walk(follower: FloorFollow, heights: torch.Tensor, chunk: int = 10, seen: bool = True) -> torch.Tensor:
    """Floors that are expected while one walks at 1.2 m/s over ground of these heights; every other half second another
    foot stands."""
    time = torch.arange(len(heights)) / 30
    head = torch.stack([1.2 * time, 0 * time, heights + 1.6], -1)
    feet = torch.stack([1.2 * time, 0 * time, heights + SOLE], -1)[:, None].expand(-1, 2, 3)
    left = ((2 * time).long() % 2 == 0).float()
    contact = torch.stack([left, 1 - left], -1) * float(seen)
    floors = []
    for some in torch.arange(len(heights)).split(chunk):
        floors.append(follower.ahead(head[some]))
        follower.follow(contact[some], feet[some])
    return torch.cat(floors)


@pytest.mark.parametrize("chunk", [1, 10, 20])
@pytest.mark.parametrize("slope", [0.0, 0.1, -0.15])
def test_slopes_are_followed_without_lag(slope, chunk):
    heights = slope * 1.2 * torch.arange(300) / 30
    floors = walk(FloorFollow(0.0, SOLE, 30.0), heights, chunk)
    assert (floors - heights)[60:].abs().max() < 0.03


def test_feet_correct_a_wrong_beginning():
    floors = walk(FloorFollow(0.4, SOLE, 30.0), torch.zeros(300))
    assert floors[-1].abs() < 0.01
    assert walk(FloorFollow(0.4, SOLE, 30.0), torch.zeros(300), seen=False)[-1] == pytest.approx(0.4, abs=0.01)


def test_sitting_down_is_no_way_down():
    follower = FloorFollow(0.0, SOLE, 30.0)
    head = torch.stack([torch.zeros(60), torch.zeros(60), torch.linspace(1.6, 1.1, 60)], -1)
    assert follower.ahead(head).abs().max() < 0.01


@pytest.mark.parametrize("sway", [0.0, 0.3, 0.5])
def test_a_squat_does_not_take_the_floor_down(sway):
    """The head goes down by 60 cm and forward, and comes back, in two seconds: too fast a sway to look unlike walking."""
    time = torch.arange(60) / 30
    bent = (1 - torch.cos(torch.pi * time)) / 2
    heads = torch.stack([sway * bent, torch.zeros(60), 1.6 - 0.6 * bent], 1)
    follower = FloorFollow(0.0, SOLE, 30.0)
    follower.ahead(torch.tensor([[0.0, 0.0, 1.6]]).expand(60, 3))
    floors = torch.cat([follower.ahead(part) for part in heads.split(20)])
    assert floors.abs().max() < 0.08
    assert floors[-1].abs() < 0.04


def test_points_below_a_sole_that_is_off_draw_the_floor_to_themselves():
    follower = FloorFollow(0.0, SOLE, 30.0)
    follower.see(torch.cat([points_at(0.0), points_at(0.0) - torch.tensor([0.0, 0.2, 0.0])]))
    for _ in range(60):
        follower.ahead(torch.tensor([[0.0, 0.0, 1.6]]))
        follower.follow(*stand(1, 0.05 + SOLE))
    assert level(follower) == pytest.approx(0.0, abs=0.01)


def test_points_that_are_not_finite_are_left_out():
    follower = FloorUpdate(0.0)
    follower.see(torch.full((30, 3), torch.nan))
    follower.follow(*stand(12, 0.3, right=0.0))
    assert level(follower) == pytest.approx(0.3)


def test_a_fixed_floor_stays():
    follower = FloorFixed(0.2)
    follower.follow(*stand(60, 3.0, right=0.0))
    assert level(follower) == pytest.approx(0.2)
