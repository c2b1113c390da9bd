"""SuperPoint: the published names, suppression against a greedy loop, sampling against a plain bilinear one."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from wearcap.models.superpoint import SuperPoint, sample_descriptors, suppress, top_keypoints

PUBLISHED = {
    "conv1a": (64, 1, 3, 3),
    "conv1b": (64, 64, 3, 3),
    "conv2a": (64, 64, 3, 3),
    "conv2b": (64, 64, 3, 3),
    "conv3a": (128, 64, 3, 3),
    "conv3b": (128, 128, 3, 3),
    "conv4a": (128, 128, 3, 3),
    "conv4b": (128, 128, 3, 3),
    "convPa": (256, 128, 3, 3),
    "convPb": (65, 256, 1, 1),
    "convDa": (256, 128, 3, 3),
    "convDb": (256, 256, 1, 1),
}


@pytest.fixture(scope="module")
def network() -> SuperPoint:
    torch.manual_seed(0)
    return SuperPoint(max_keypoints=100).eval().requires_grad_(False)


def greedy(heat: np.ndarray, radius: int) -> np.ndarray:
    """Suppression as one would do it by hand: from the best pixel on, each silences its square."""
    kept = np.zeros_like(heat)
    silent = np.zeros(heat.shape, bool)
    for place in np.argsort(-heat, axis=None):
        y, x = np.unravel_index(place, heat.shape)
        if not silent[y, x]:
            kept[y, x] = heat[y, x]
            silent[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1] = True
    return kept


def test_parameters_are_those_of_the_published_file():
    expected = {f"{name}.weight": shape for name, shape in PUBLISHED.items()}
    expected |= {f"{name}.bias": shape[:1] for name, shape in PUBLISHED.items()}
    assert {name: tuple(value.shape) for name, value in SuperPoint().state_dict().items()} == expected


@given(st.integers(0, 1000), st.integers(0, 5))
def test_suppression_run_to_its_end_is_greedy_suppression(seed, radius):
    heat = torch.rand(2, 17, 23, generator=torch.Generator().manual_seed(seed))
    kept = suppress(heat, radius, rounds=60)
    np.testing.assert_array_equal(kept, np.stack([greedy(one, radius) for one in heat.numpy()]))


def test_three_rounds_keep_only_what_greedy_suppression_keeps():
    heat = torch.rand(1, 60, 80, generator=torch.Generator().manual_seed(0))
    kept, all_kept = suppress(heat, 4)[0].numpy(), greedy(heat[0].numpy(), 4)
    assert set(np.flatnonzero(kept)) <= set(np.flatnonzero(all_kept))
    assert np.count_nonzero(kept) > 0.9 * np.count_nonzero(all_kept)
    one_round = suppress(heat, 4, rounds=1)[0].numpy()
    assert np.count_nonzero(one_round) < np.count_nonzero(kept)


def test_top_keypoints_are_the_highest_pixels_inside_the_border():
    heat = torch.rand(2, 20, 30, generator=torch.Generator().manual_seed(1))
    keypoints, scores = top_keypoints(heat, 7, border=4)
    for one, found, score in zip(heat.numpy(), keypoints.numpy(), scores.numpy()):
        inside = [(one[y, x], x, y) for y in range(4, 16) for x in range(4, 26)]
        best = sorted(inside, reverse=True)[:7]
        np.testing.assert_array_equal(found, [place[1:] for place in best])
        np.testing.assert_array_equal(score, [place[0] for place in best])


def test_more_keypoints_than_pixels_are_filled_up_with_zeros():
    keypoints, scores = top_keypoints(torch.ones(1, 16, 16), 4096, border=4)
    assert keypoints.shape == (1, 256, 2)
    assert (scores > 0).sum() == 64


def test_descriptors_are_bilinear_samples_of_unit_length():
    """Against a loop over keypoints, with the published mapping of pixels to cells."""
    rng = np.random.default_rng(0)
    coarse = rng.normal(size=(5, 6, 9)).astype(np.float32)
    keypoints = rng.uniform([4, 4], [9 * 8 - 5, 6 * 8 - 5], (40, 2)).astype(np.float32)
    sampled = sample_descriptors(torch.from_numpy(coarse)[None], torch.from_numpy(keypoints)[None])[0]
    for (x, y), found in zip(keypoints, sampled.numpy()):
        u, v = (x - 3.5) / (9 * 8 - 4.5) * 8, (y - 3.5) / (6 * 8 - 4.5) * 5
        i, j = int(u), int(v)
        a, b = u - i, v - j
        expected = (1 - b) * ((1 - a) * coarse[:, j, i] + a * coarse[:, j, i + 1])
        expected += b * ((1 - a) * coarse[:, j + 1, i] + a * coarse[:, j + 1, i + 1])
        np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=2e-5)


def test_a_place_of_the_detector_is_a_pixel_of_the_cell():
    """Class 19 of 65 is row 2, column 3 of each cell of 8 × 8; class 64 is no pixel."""
    network = SuperPoint().eval().requires_grad_(False)
    network.convPb.weight.zero_()
    network.convPb.bias.copy_(torch.eye(65)[19] * 20)
    heat, _ = network.dense(torch.rand(1, 1, 32, 48))
    np.testing.assert_array_equal(np.argwhere(heat[0].numpy() > 0.5)[:7, 1], [3, 11, 19, 27, 35, 43, 3])
    np.testing.assert_array_equal(np.unique(np.argwhere(heat[0].numpy() > 0.5)[:, 0]), [2, 10, 18, 26])
    network.convPb.bias.copy_(torch.eye(65)[64] * 20)
    assert network.dense(torch.rand(1, 1, 32, 48))[0].max() < 1e-6


def test_output_is_sorted_normalised_and_the_same_each_time(network):
    image = torch.rand(2, 1, 67, 90, generator=torch.Generator().manual_seed(2))
    keypoints, descriptors, scores = network(image)
    assert keypoints.shape == (2, 100, 2)
    assert descriptors.shape == (2, 100, 256)
    torch.testing.assert_close(descriptors.norm(dim=-1), torch.ones(2, 100))
    assert (scores.diff(dim=1) <= 0).all()
    found = keypoints[scores > 0]
    assert found.min() >= 4
    assert (found[:, 0] < 88 - 4).all()  # 90 pixels are 11 cells
    assert (found[:, 1] < 64 - 4).all()
    for first, again in zip((keypoints, descriptors, scores), network(image)):
        assert torch.equal(first, again)


def test_a_picture_moved_by_a_cell_moves_the_heat(network):
    image = torch.rand(1, 1, 176, 176, generator=torch.Generator().manual_seed(3))
    whole, moved = network.dense(image)[0], network.dense(image[:, :, 8:, 16:])[0]
    margin = 48  # beyond the reach of the network's padding
    torch.testing.assert_close(
        whole[:, 8 + margin : -margin, 16 + margin : -margin], moved[:, margin:-margin, margin:-margin]
    )


def test_it_exports_as_one_graph(network):
    image = torch.rand(1, 1, 64, 96, generator=torch.Generator().manual_seed(4))
    program = torch.export.export(network, (image,))
    for ours, exported in zip(network(image), program.module()(image)):
        torch.testing.assert_close(ours, exported)
