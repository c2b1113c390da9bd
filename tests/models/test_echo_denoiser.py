"""ECHO's denoiser: levels of every modality, absent objects, padding, the paper's size."""

import pytest
import torch
from hydra.utils import instantiate

from carried_box import WINDOW, small_features, small_net
from wearcap.cli.conf import compose
from wearcap.systems.echo.model import MODALITIES, EchoDenoiser

FEATURES = small_features()


def inputs(net: EchoDenoiser, time: int = WINDOW):
    random = torch.Generator().manual_seed(0)
    x_t = torch.randn(2, time, sum(net.sizes), generator=random)
    level = torch.rand(2, time, 3, generator=random)
    condition = torch.randn(2, time, FEATURES.condition_size, generator=random)
    code = torch.randn(2, time, FEATURES.object_condition_size, generator=random)
    there = torch.ones(2, time, dtype=torch.bool)
    return x_t, level, condition, code, there, there.clone()


def outputs(net: EchoDenoiser, x_t, level, condition, code, has_object, valid):
    return net(x_t, level, net.encode(condition, net.object(code), has_object, valid), valid)


nets = pytest.mark.parametrize("net", [{}, {"streams": 3}, {"blend": 5}], indirect=True)


@pytest.fixture
def net(request):
    return small_net(FEATURES, **getattr(request, "param", {}))


@nets
@pytest.mark.parametrize("modality", range(3))
def test_each_modalitys_level_and_noise_reach_all_outputs(net, modality):
    x_t, level, *conditioning = inputs(net)
    before = outputs(net, x_t, level, *conditioning)
    assert before.shape == x_t.shape
    other = level.clone()
    other[:, 3, modality] = 1 - other[:, 3, modality]
    noised = [part.clone() for part in x_t.split(net.sizes, -1)]
    noised[modality][:, 3] += 1.0
    for after in (outputs(net, x_t, other, *conditioning), outputs(net, torch.cat(noised, -1), level, *conditioning)):
        for part in (after - before).split(net.sizes, -1):
            assert part.abs().max() > 1e-6


@nets
def test_padding_changes_nothing_on_the_frames_that_exist(net):
    x_t, level, condition, code, has, valid = inputs(net)
    valid[:, 9:] = False
    before = outputs(net, x_t, level, condition, code, has, valid)
    has = has.clone()
    x_t[:, 9:], level[:, 9:], condition[:, 9:], code[:, 9:], has[:, 9:] = 99.0, 0.5, -99.0, 99.0, False
    after = outputs(net, x_t, level, condition, code, has, valid)
    torch.testing.assert_close(after[:, :9], before[:, :9], atol=1e-4, rtol=0)


@nets
def test_a_short_window_is_a_padded_one(net):
    x_t, level, condition, code, has, valid = inputs(net)
    valid[:, 9:] = False
    padded = outputs(net, x_t, level, condition, code, has, valid)[:, :9]
    short = outputs(net, *(part[:, :9] for part in (x_t, level, condition, code, has, valid)))
    torch.testing.assert_close(short, padded, atol=1e-4, rtol=0)


def test_without_an_object_its_code_means_nothing(net):
    x_t, level, condition, code, has, valid = inputs(net)
    none = torch.zeros_like(has)
    one, two = (outputs(net, x_t, level, condition, part, none, valid) for part in (code, 7 - code))
    assert torch.equal(one, two)
    with_it = outputs(net, x_t, level, condition, code, has, valid)
    assert (with_it - one).abs().max() > 1e-3
    other = outputs(net, x_t, level, condition, code + 1, has, valid)
    assert (with_it - other).abs().max() > 1e-3


def test_a_level_per_window_is_the_broadcast_case(net):
    x_t, _, condition, code, has, valid = inputs(net)
    level = torch.full((2, 1, 3), 0.4)
    plan = net.plan(level.expand(-1, WINDOW, -1))
    one = net.plan(level[:1].expand(-1, WINDOW, -1))
    encoded = net.encode(condition, net.object(code), has, valid)
    torch.testing.assert_close(
        net.step(x_t, plan, encoded, valid), net.step(x_t, one, encoded, valid), atol=1e-5, rtol=0
    )


@nets
def test_gradients_reach_every_parameter(net):
    x_t, level, condition, code, has, valid = inputs(net)
    has[0, :8] = False
    outputs(net, x_t, level, condition, code, has, valid).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_a_modalitys_level_is_that_of_all_its_features(net):
    level = torch.rand(2, 5, 3)
    wide = net.per_feature(level)
    for k, part in enumerate(wide.split(net.sizes, -1)):
        assert torch.equal(part, level[..., k : k + 1].expand_as(part))
    assert len(net.sizes) == len(MODALITIES)


def test_streams_are_one_or_one_per_modality():
    with pytest.raises(ValueError, match="2 streams, but there are 3 modalities"):
        small_net(FEATURES, streams=2)


def test_the_papers_size():
    config = compose("train", ["experiment=echo", "model=echo", "paths.run=none"])
    count = sum(parameter.numel() for parameter in instantiate(config.model, _convert_="all").net.parameters())
    assert 44.9e6 <= count <= 49.7e6, f"{count / 1e6:.1f} M parameters"
