"""The denoiser: shapes, padding, levels, normalisation."""

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.models.layers import Normalizer, TransformerSize
from wearcap.systems.hmd2.model import Conditions, MotionDenoiser


def small(**changes) -> MotionDenoiser:
    settings = {"motion_size": 12, "condition_size": 5, "window": 16}
    net = MotionDenoiser(**settings, transformer=TransformerSize(32, 2, 4, 64, 0.0), **changes)
    for parameter in net.parameters():  # zero-initialised gates would hide what the blocks do
        torch.nn.init.normal_(parameter, std=0.1)
    return net.eval()


def conditions_of(head: torch.Tensor, points: int = 0, image: int = 0) -> Conditions:
    """Conditions of a head alone, or with random points and pictures everywhere."""
    batch, time, _ = head.shape
    there = torch.ones(batch, time, dtype=torch.bool)
    given = there[..., None].expand(-1, -1, (points > 0) + (image > 0))
    return Conditions(head, torch.randn(batch, time, points + image), given)


def denoise(net: MotionDenoiser, x_t, level, condition, valid) -> torch.Tensor:
    """x̂0 from a head's condition alone."""
    return net(x_t, level, net.encode(conditions_of(condition), valid), valid)


def inputs(time: int = 16):
    torch.manual_seed(0)
    return (torch.randn(2, time, 12), torch.rand(2, 1), torch.randn(2, time, 5), torch.ones(2, time, dtype=torch.bool))


@pytest.mark.parametrize(("frames_per_token", "mixing"), [(1, "attention"), (4, "attention"), (1, "mlp")])
def test_padding_changes_nothing_on_the_frames_that_exist(frames_per_token, mixing):
    net = small(frames_per_token=frames_per_token, mixing=mixing)
    x_t, level, condition, valid = inputs()
    valid[:, 8:] = False
    out = denoise(net, x_t, level, condition, valid)
    x_t[:, 8:], condition[:, 8:] = 99.0, -99.0
    assert torch.allclose(denoise(net, x_t, level, condition, valid)[:, :8], out[:, :8], atol=1e-5)


@pytest.mark.parametrize("mixing", ["attention", "mlp"])
def test_a_window_without_any_frame_is_finite(mixing):
    x_t, level, condition, valid = inputs()
    assert denoise(small(mixing=mixing), x_t, level, condition, valid & False).isfinite().all()


def test_an_mlp_mixes_frames_and_other_ways_are_named():
    net, (x_t, level, condition, valid) = small(mixing="mlp"), inputs()
    before = denoise(net, x_t, level, condition, valid)
    x_t[:, 0] += 1.0
    assert (denoise(net, x_t, level, condition, valid) - before)[:, 15].abs().max() > 1e-4
    with pytest.raises(WearcapError, match="no mixing 'convolution'"):
        small(mixing="convolution")


def test_level_per_frame_equals_level_per_window_when_all_are_the_same():
    net = small(frames_per_token=4)
    x_t, level, condition, valid = inputs()
    assert torch.allclose(
        denoise(net, x_t, level, condition, valid),
        denoise(net, x_t, level.expand(2, 16).contiguous(), condition, valid),
        atol=1e-5,
    )


def test_level_condition_and_order_of_frames_matter():
    net = small()
    x_t, level, condition, valid = inputs()
    out = denoise(net, x_t, level, condition, valid)
    assert not torch.allclose(denoise(net, x_t, 1 - level, condition, valid), out, atol=1e-3)
    assert not torch.allclose(denoise(net, x_t, level, condition + 1, valid), out, atol=1e-3)
    assert not torch.allclose(denoise(net, x_t.flip(1), level, condition.flip(1), valid).flip(1), out, atol=1e-3)


def test_window_must_split_into_tokens():
    with pytest.raises(ValueError, match="does not split"):
        small(frames_per_token=5)


def test_normalizer_inverts_and_travels_with_the_weights():
    normalizer = Normalizer(3)
    normalizer.set(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.5, 1.0, 2.0]))
    x = torch.randn(4, 3)
    assert torch.allclose(normalizer.inverse(normalizer(x)), x, atol=1e-6)
    other = Normalizer(3)
    other.load_state_dict(normalizer.state_dict())
    assert torch.equal(other(x), normalizer(x))


def test_blending_is_smoother_and_never_mixes_in_padding():
    x_t, level, condition, valid = inputs()
    valid[:, 10:] = False
    blended = small(blend=5)
    out = denoise(blended, x_t, level, condition, valid)
    x_t[:, 10:] = 50.0
    assert torch.allclose(denoise(blended, x_t, level, condition, valid)[:, :10], out[:, :10], atol=1e-5)
    plain = blended.blend
    blended.blend = None
    rough = denoise(blended, x_t, level, condition, valid)[:, :10]
    assert out[:, :10].diff(dim=1).square().mean() < 0.5 * rough.diff(dim=1).square().mean()
    constant = torch.ones(2, 16, 12)
    assert torch.allclose(plain(constant, valid)[:, :10], constant[:, :10])


def test_a_missing_modality_is_null_whatever_its_numbers_are():
    net = small(conditions={"points": 3, "image": 4})
    _, _, head, valid = inputs()
    whole = conditions_of(head, 3, 4)
    blind = whole._replace(given=whole.given & False)
    other = blind._replace(others=torch.cat([blind.others[..., :3] + 5, blind.others[..., 3:] * torch.inf], -1))
    assert torch.equal(net.encode(blind, valid), net.encode(other, valid))
    for number, part in enumerate((slice(0, 3), slice(3, 7))):
        more, given = torch.zeros(7), torch.ones(2, dtype=torch.bool)
        more[part], given[number] = 1, False
        changed = whole._replace(others=whole.others + more)
        assert not torch.allclose(net.encode(changed, valid), net.encode(whole, valid), atol=1e-3)
        gone = whole._replace(given=whole.given & given)
        assert not torch.allclose(net.encode(gone, valid), net.encode(whole, valid), atol=1e-3)


def test_a_scene_at_the_null_vector_is_not_taken_for_a_missing_one():
    net = small(conditions={"points": 3}, frames_per_token=4)
    _, _, head, valid = inputs()
    points = net.condition_encoder.points
    at_null = conditions_of(head, 3)._replace(others=points.normalizer.inverse(points.null).expand(2, 16, 3))
    gone = at_null._replace(given=at_null.given & False)
    assert not torch.allclose(net.encode(at_null, valid), net.encode(gone, valid), atol=1e-3)


def test_self_conditioning_listens_to_the_last_answer():
    net = small(self_conditioning=True)
    x_t, level, head, valid = inputs()
    encoded = net.encode(conditions_of(head), valid)
    first = net(x_t, level, encoded, valid)
    assert torch.equal(net(x_t, level, encoded, valid, torch.zeros_like(x_t)), first)
    assert not torch.allclose(net(x_t, level, encoded, valid, first), first, atol=1e-3)
