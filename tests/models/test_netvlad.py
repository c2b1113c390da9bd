"""NetVLAD: pytorch-NetVlad's names, and the pooling against its formula in plain loops."""

import numpy as np
import pytest
import torch

from wearcap.models.netvlad import NetVLAD, VladPooling

VGG16 = {
    0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256),
    17: (512, 256), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512),
}  # fmt: skip


@pytest.fixture(scope="module")
def network() -> NetVLAD:
    torch.manual_seed(0)
    return NetVLAD(whitened=16).eval().requires_grad_(False)


def test_parameters_are_those_of_the_published_checkpoints(network):
    expected = {f"encoder.{place}.weight": (*shape, 3, 3) for place, shape in VGG16.items()}
    expected |= {f"encoder.{place}.bias": shape[:1] for place, shape in VGG16.items()}
    expected |= {"pool.centroids": (64, 512), "pool.conv.weight": (64, 512, 1, 1)}
    plain, with_bias = NetVLAD(), NetVLAD(bias=True)
    assert {name: tuple(value.shape) for name, value in plain.state_dict().items()} == expected
    assert with_bias.state_dict().keys() - expected.keys() == {"pool.conv.bias"}
    whitening = {"WPCA.0.weight": (16, 64 * 512, 1, 1), "WPCA.0.bias": (16,)}
    assert {name: tuple(value.shape) for name, value in network.state_dict().items()} == expected | whitening


@pytest.mark.parametrize("bias", [False, True])
def test_pooling_is_its_formula(bias):
    torch.manual_seed(1)
    pool = VladPooling(4, 6, bias).double().requires_grad_(False)
    pool.centroids.normal_()
    x = torch.randn(2, 6, 3, 5, dtype=torch.float64)
    weight, centroids = pool.conv.weight[:, :, 0, 0].numpy(), pool.centroids.numpy()
    for picture, found in zip(x.numpy(), pool(x).numpy()):
        vlad = np.zeros((4, 6))
        for place in np.ndindex(3, 5):
            local = picture[:, place[0], place[1]]
            local = local / np.linalg.norm(local)
            logit = weight @ local + (pool.conv.bias.numpy() if bias else 0)
            share = np.exp(logit) / np.exp(logit).sum()
            for cluster in range(4):
                vlad[cluster] += share[cluster] * (local - centroids[cluster])
        vlad /= np.linalg.norm(vlad, axis=1, keepdims=True)
        np.testing.assert_allclose(found, vlad.ravel() / np.linalg.norm(vlad), atol=1e-12)


def test_trunk_is_vgg16_up_to_conv5_3(network):
    kinds = [type(layer).__name__ for layer in network.encoder]
    assert [place for place, kind in enumerate(kinds) if kind == "MaxPool2d"] == [4, 9, 16, 23]
    assert kinds[-1] == "Conv2d"
    assert network.encoder(torch.rand(1, 3, 64, 96)).shape == (1, 512, 4, 6)


def test_colours_are_scaled_as_for_imagenet(network):
    seen = []
    hook = network.encoder.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    colour = torch.tensor([0.485, 0.456 + 0.224, 0.406 - 2 * 0.225])
    network(colour[:, None, None].expand(1, 3, 32, 32))
    hook.remove()
    torch.testing.assert_close(seen[0][0, :, 5, 7], torch.tensor([0.0, 1.0, -2.0]))


def test_output_is_of_unit_length_and_the_same_each_time(network):
    image = torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    descriptor = network(image)
    assert descriptor.shape == (2, 16)
    torch.testing.assert_close(descriptor.norm(dim=1), torch.ones(2))
    assert torch.equal(descriptor, network(image))
    assert not torch.allclose(descriptor[0], descriptor[1])
    torch.testing.assert_close(network(image[1:])[0], descriptor[1])


def test_without_whitening_it_is_the_pooling():
    network = NetVLAD(clusters=8).eval().requires_grad_(False)
    assert network(torch.rand(1, 3, 32, 32)).shape == (1, 8 * 512)
