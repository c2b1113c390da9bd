import numpy as np
import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.scene.floor import estimate_floor


def surface(rng, low, high, z, count):
    """Points of a horizontal rectangle with 1 cm of noise."""
    xy = rng.uniform(low, high, (count, 2))
    return np.column_stack([xy, np.full(count, z) + rng.normal(0, 0.01, count)])


def flat_room(seed=0, floor=-0.4):
    """A room seen by SLAM: few points on the floor, many on a table, walls, and stray ones below the floor."""
    rng = np.random.default_rng(seed)
    walls = np.column_stack(
        [rng.uniform(0, 6, 4000), rng.choice([0.0, 5.0], 4000), rng.uniform(floor, floor + 2.5, 4000)]
    )
    stray = np.column_stack([rng.uniform(0, 6, (60, 2)), rng.uniform(floor - 1.5, floor - 0.1, 60)])
    return np.concatenate(
        [surface(rng, (0, 0), (6, 5), floor, 1500), surface(rng, (2, 2), (3.5, 3), floor + 0.74, 3000), walls, stray]
    )


def stairs(seed=0, steps=16, rise=0.17, tread=0.28):
    """Ground floor, 16 steps up along +x, upper floor; and the head path of one who climbs them."""
    rng = np.random.default_rng(seed)
    parts = [surface(rng, (-4, -1), (0, 1), 0.0, 2500)]
    parts += [surface(rng, (i * tread, -0.6), ((i + 1) * tread, 0.6), (i + 1) * rise, 150) for i in range(steps)]
    parts += [surface(rng, (steps * tread, -1), (steps * tread + 4, 1), steps * rise, 2500)]
    x = np.linspace(-3, steps * tread + 3, 900)
    floor = np.clip(np.floor(x / tread) + 1, 0, steps) * rise
    smooth = np.convolve(np.pad(floor, 45, mode="edge"), np.ones(91) / 91, mode="valid")
    return np.concatenate(parts), np.column_stack([x, np.zeros(900), smooth + 1.6]), floor


def as_tensor(array):
    return torch.tensor(array, dtype=torch.float32)


def test_flat_room_with_table_and_strays():
    """The head walks round the table and bends over it: the floor stays where it is."""
    angle = np.linspace(0, 2 * np.pi, 600)
    height = 1.2 + 0.05 * np.sin(20 * angle)
    height[300:380] -= 0.5
    head = np.column_stack([2.7 + 1.6 * np.cos(angle), 2.5 + 1.2 * np.sin(angle), height])
    estimate = estimate_floor(as_tensor(flat_room()), as_tensor(head))
    assert (estimate.height + 0.4).abs().max() < 0.02
    assert estimate.confidence.median() > 0.5


def test_sitting_at_the_table_keeps_the_floor():
    head = np.repeat([[2.2, 2.3, 0.8]], 200, 0)
    walk_up = np.column_stack([np.linspace(0.5, 2.2, 150), np.full(150, 2.3), np.full(150, 1.2)])
    estimate = estimate_floor(as_tensor(flat_room()), as_tensor(np.concatenate([walk_up, head])))
    assert (estimate.height + 0.4).abs().max() < 0.02


def test_stairs_are_followed():
    points, head, floor = stairs()
    error = (estimate_floor(as_tensor(points), as_tensor(head)).height - as_tensor(floor)).abs()
    on_floors = (head[:, 0] < -0.8) | (head[:, 0] > 16 * 0.28 + 0.8)
    assert error[on_floors].max() < 0.03
    assert error[~on_floors].mean() < 0.09, "half a step, rise 0.17 m"
    assert error.max() < 0.2


def test_ceiling_of_the_storey_below_is_no_floor():
    """A layer twice as strong, 15 cm below the upper floor, seen from below."""
    points, head, floor = stairs()
    rng = np.random.default_rng(1)
    ceiling = surface(rng, (16 * 0.28, -1), (16 * 0.28 + 4, 1), 16 * 0.17 - 0.15, 5000)
    error = estimate_floor(as_tensor(np.concatenate([points, ceiling])), as_tensor(head)).height - as_tensor(floor)
    assert error[head[:, 0] > 16 * 0.28 + 0.8].abs().max() < 0.03


def test_a_hundred_points_suffice():
    """Sparse clouds: three points per square metre of floor, noise of 3 cm, furniture and walls besides."""
    room = flat_room()
    rng = np.random.default_rng(4)
    points = room[rng.permutation(len(room))[:500]] + rng.normal(0, 0.03, (500, 3))
    angle = np.linspace(0, 2 * np.pi, 600)
    head = np.column_stack([2.7 + 1.6 * np.cos(angle), 2.5 + 1.2 * np.sin(angle), np.full(600, 1.2)])
    error = estimate_floor(as_tensor(points), as_tensor(head)).height + 0.4
    assert error.abs().mean() < 0.05


def test_unseen_places_carry_over_with_no_confidence():
    points = flat_room()
    head = np.column_stack([np.linspace(1, 20, 400), np.full(400, 1.5), np.full(400, 1.2)])
    estimate = estimate_floor(as_tensor(points), as_tensor(head))
    assert (estimate.height + 0.4).abs().max() < 0.03
    assert estimate.confidence[-100:].max() == 0.0
    assert estimate.confidence[:50].min() > 0.3


def test_it_moves_with_the_world():
    """Raised by 3 m and turned about the vertical, the answer is raised by 3 m."""
    points, head, _ = stairs()
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    moved = estimate_floor(as_tensor(points @ turn.T + [5, 2, 3]), as_tensor(head @ turn.T + [5, 2, 3]))
    plain = estimate_floor(as_tensor(points), as_tensor(head))
    assert (moved.height - plain.height - 3).abs().mean() < 0.05


def test_refusals():
    with pytest.raises(WearcapError, match="no points below"):
        estimate_floor(torch.tensor([[0.0, 0.0, 5.0]]), torch.zeros(10, 3))
    with pytest.raises(WearcapError, match="no head path"):
        estimate_floor(torch.zeros(4, 3), torch.zeros(0, 3))


@pytest.mark.real
def test_real_room(real_data):
    """Aria's sample: the trajectory begins at z = 0 with the wearer standing; the floor is one level below."""
    from wearcap.io.devices.aria_mps import read_mps

    recording = read_mps(real_data / "aria_mps")
    assert recording.head is not None
    assert recording.points is not None
    estimate = estimate_floor(recording.points.points_world, recording.head.t_world_device)
    clearance = recording.head.t_world_device[:, 2] - estimate.height
    assert estimate.height.max() - estimate.height.min() < 0.1
    assert 1.3 < clearance[:60].mean() < 1.9
    assert estimate.confidence.median() > 0.5
