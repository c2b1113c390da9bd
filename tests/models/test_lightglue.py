"""LightGlue: the published names, what it must not depend on, its formulas in plain loops, planted matches."""

import numpy as np
import pytest
import torch

from wearcap.models.lightglue import (
    LightGlue,
    MatchAssignment,
    RotaryPosition,
    SelfBlock,
    mutual_matches,
    normalized,
    renamed,
)

SIZE = torch.tensor([[640.0, 480.0]])
FFN = {"ffn.0": (512, 512), "ffn.1": (512,), "ffn.3": (256, 512)}
SELF = {"Wqkv": (768, 256), "out_proj": (256, 256)} | FFN
CROSS = {"to_qk": (256, 256), "to_v": (256, 256), "to_out": (256, 256)} | FFN
ASSIGNMENT = {"matchability": (1, 256), "final_proj": (256, 256)}


def published() -> dict[str, tuple[int, ...]]:
    """Names and shapes of `superpoint_lightglue.pth` as released."""
    layers = {
        f"{block}.{layer}.{name}": shape
        for block, parts in (("self_attn", SELF), ("cross_attn", CROSS), ("log_assignment", ASSIGNMENT))
        for layer in range(9)
        for name, shape in parts.items()
    }
    layers |= {f"token_confidence.{layer}.token.0": (1, 256) for layer in range(8)}
    expected = {"posenc.Wr.weight": (32, 2)}
    for name, shape in layers.items():
        expected |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    return expected


@pytest.fixture(scope="module")
def network() -> LightGlue:
    torch.manual_seed(0)
    return LightGlue(width=32, layers=3, heads=2, stop_confidence=None).eval().requires_grad_(False)


def pictures(count0: int, count1: int, width: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    arguments = []
    for count in (count0, count1):
        descriptors = torch.randn(1, count, width, generator=generator)
        keypoints = torch.rand(1, count, 2, generator=generator) * SIZE
        arguments += [keypoints, torch.nn.functional.normalize(descriptors, dim=-1), SIZE]
    return tuple(arguments)


def test_parameters_are_those_of_the_published_file():
    """Also of later releases, which use the new names and save the thresholds of stopping."""
    released = {name: torch.zeros(shape) for name, shape in published().items()}
    own = {name: tuple(value.shape) for name, value in LightGlue().state_dict().items()}
    assert {name: tuple(value.shape) for name, value in renamed(released).items()} == own
    later = renamed(released) | {"confidence_thresholds": torch.zeros(9)}
    assert renamed(later).keys() == own.keys()
    assert "transformers.8.cross_attn.to_qk.weight" in own


def test_the_order_of_keypoints_does_not_matter(network):
    keypoints0, descriptors0, _, keypoints1, descriptors1, _ = pictures(13, 17, 32)
    generator = torch.Generator().manual_seed(5)
    order0, order1 = torch.randperm(13, generator=generator), torch.randperm(17, generator=generator)
    plain = network(keypoints0, descriptors0, SIZE, keypoints1, descriptors1, SIZE)
    shuffled = network(
        keypoints0[:, order0], descriptors0[:, order0], SIZE, keypoints1[:, order1], descriptors1[:, order1], SIZE
    )
    torch.testing.assert_close(shuffled, plain[:, order0][:, :, order1], atol=1e-5, rtol=1e-5)
    assert not torch.allclose(shuffled, plain, atol=1e-3)


def test_the_order_of_pictures_does_not_matter(network):
    arguments = pictures(13, 17, 32)
    plain, swapped = network(*arguments), network(*arguments[3:], *arguments[:3])
    torch.testing.assert_close(swapped, plain.transpose(1, 2), atol=1e-5, rtol=1e-5)


def test_only_where_keypoints_lie_to_each_other_counts(network):
    keypoints0, *rest = pictures(13, 17, 32)
    plain = network(keypoints0, *rest)
    moved = network(keypoints0 + torch.tensor([31.0, -17.0]), *rest)
    torch.testing.assert_close(moved, plain, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(network(keypoints0 * torch.tensor([0.5, 1]), *rest), plain, atol=1e-3)


def test_places_are_about_the_middle_in_halves_of_the_longer_side():
    corners = torch.tensor([[[0.0, 0.0], [640.0, 480.0], [320.0, 240.0]]])
    torch.testing.assert_close(normalized(corners, SIZE), torch.tensor([[[-1.0, -0.75], [1.0, 0.75], [0.0, 0.0]]]))


def test_self_attention_is_its_formula_in_the_published_layout():
    """Eq. 5-7 with loops; q, k, v of feature d of head h are rows 3 (h D + d) + 0, 1, 2 of Wqkv."""
    torch.manual_seed(3)
    heads, depth, points = 2, 4, 5
    block, position = SelfBlock(heads * depth, heads).double(), RotaryPosition(depth).double()
    x = torch.randn(points, heads * depth, dtype=torch.float64)
    place = torch.randn(points, 2, dtype=torch.float64)
    angle = place @ position.Wr.weight.T
    projected = x @ block.Wqkv.weight.T + block.Wqkv.bias

    def vector(point: int, head: int, which: int, turned: bool) -> torch.Tensor:
        rows = [3 * (head * depth + d) + which for d in range(depth)]
        value = projected[point, rows]
        if not turned:
            return value
        pairs = []
        for pair in range(depth // 2):
            cos, sin = angle[point, pair].cos(), angle[point, pair].sin()
            pairs.append(torch.stack([torch.stack([cos, -sin]), torch.stack([sin, cos])]))
        return torch.block_diag(*pairs) @ value

    seen = torch.zeros(points, heads * depth, dtype=torch.float64)
    for point in range(points):
        for head in range(heads):
            query = vector(point, head, 0, True)
            scores = torch.stack([query @ vector(other, head, 1, True) for other in range(points)])
            share = (scores / depth**0.5).softmax(0)
            seen[point, head * depth : (head + 1) * depth] = sum(
                share[other] * vector(other, head, 2, False) for other in range(points)
            )
    message = seen @ block.out_proj.weight.T + block.out_proj.bias
    expected = x + block.ffn(torch.cat([x, message], -1))
    torch.testing.assert_close(block(x[None], position(place[None]))[0], expected)


def test_assignment_is_its_formula():
    """Eq. 8-9 with loops."""
    torch.manual_seed(4)
    assignment = MatchAssignment(6).double().requires_grad_(False)
    x0, x1 = torch.randn(4, 6, dtype=torch.float64), torch.randn(3, 6, dtype=torch.float64)
    similarity = np.array(
        [[float(assignment.final_proj(a) @ assignment.final_proj(b)) / 6**0.5 for b in x1] for a in x0]
    )
    matchable0 = [torch.sigmoid(assignment.matchability(a)).item() for a in x0]
    matchable1 = [torch.sigmoid(assignment.matchability(b)).item() for b in x1]
    found = assignment(x0[None], x1[None])[0].exp().numpy()
    for i, j in np.ndindex(4, 3):
        row, column = np.exp(similarity[i]), np.exp(similarity[:, j])
        both = np.exp(similarity[i, j]) ** 2 / row.sum() / column.sum()
        np.testing.assert_allclose(found[i, j], matchable0[i] * matchable1[j] * both)


def test_matches_are_mutual_and_probable():
    probability = torch.tensor([[0.9, 0.2, 0.1], [0.8, 0.3, 0.1], [0.1, 0.1, 0.05]])
    partner, score = mutual_matches(probability.log()[None], 0.1)
    assert partner.tolist() == [[0, -1, -1]]  # the second row's best prefers the first; the third is no one's best
    torch.testing.assert_close(score, torch.tensor([[0.9, 0.0, 0.0]]))
    assert mutual_matches(probability.log()[None], 0.95)[0].tolist() == [[-1, -1, -1]]


def test_it_stops_when_enough_keypoints_are_sure():
    torch.manual_seed(6)
    network = LightGlue(width=32, layers=3, heads=2).eval().requires_grad_(False)
    arguments = pictures(9, 11, 32)
    for token in network.token_confidence:
        token.token[0].bias.fill_(10)
    sure = network(*arguments)
    short = LightGlue(width=32, layers=1, heads=2, stop_confidence=None).eval().requires_grad_(False)
    short.load_state_dict({k: v for k, v in network.state_dict().items() if k in short.state_dict()})
    torch.testing.assert_close(sure, short(*arguments))
    for token in network.token_confidence:
        token.token[0].bias.fill_(-10)
    unsure = network(*arguments)
    network.stop_confidence = None
    assert torch.equal(unsure, network(*arguments))
    assert not torch.allclose(unsure, sure, atol=1e-3)


def twins(pairs: int, generator: torch.Generator) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
    """Two pictures of the same points, shuffled and moved, where each descriptor occurs twice: left and right.

    Only where a point lies to the others tells the twins apart.
    """
    half = torch.nn.functional.normalize(torch.randn(pairs, 16, generator=generator), dim=-1)
    descriptors = half.repeat(2, 1)
    left = torch.rand(pairs, 2, generator=generator) * torch.tensor([200.0, 480.0])
    right = torch.rand(pairs, 2, generator=generator) * torch.tensor([200.0, 480.0])
    keypoints = torch.cat([left, right + torch.tensor([300.0, 0.0])])
    order = torch.randperm(2 * pairs, generator=generator)
    moved = keypoints + torch.rand(2, generator=generator) * torch.tensor([140.0, 40.0])
    first = (keypoints[None], descriptors[None], SIZE)
    return (*first, moved[order][None], descriptors[order][None], SIZE), order.argsort()


def test_it_learns_to_tell_twins_apart_by_their_place():
    torch.manual_seed(7)
    network = LightGlue(width=16, layers=2, heads=2, stop_confidence=None)
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    generator = torch.Generator().manual_seed(8)

    def correct() -> float:
        rate = []
        for seed in range(10):
            arguments, truth = twins(8, torch.Generator().manual_seed(1000 + seed))
            rate.append((mutual_matches(network(*arguments), 0.0)[0][0] == truth).float().mean().item())
        return float(np.mean(rate))

    before = correct()
    for _ in range(250):
        arguments, truth = twins(8, generator)
        loss = -network(*arguments)[0, torch.arange(16), truth].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert before < 0.6
    assert correct() > 0.9, correct()


def test_it_exports_for_any_number_of_keypoints(network):
    count0, count1 = torch.export.Dim("count0", min=2, max=4096), torch.export.Dim("count1", min=2, max=4096)
    shapes = ({1: count0}, {1: count0}, None, {1: count1}, {1: count1}, None)
    program = torch.export.export(network, pictures(9, 11, 32), dynamic_shapes=shapes)
    arguments = pictures(21, 6, 32, seed=1)
    torch.testing.assert_close(program.module()(*arguments), network(*arguments))
