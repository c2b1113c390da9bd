"""The contact networks: the published one to the parameter, ours from the same 61 frames, released checkpoints."""

import pytest
import torch
from torch import nn

from wearcap.errors import WearcapError
from wearcap.systems.ireplica.contact_prediction import FRAMES, REACH
from wearcap.systems.ireplica.contact_sequence import ContactSequence
from wearcap.systems.ireplica.contact_transformer import ContactTransformer, EncoderLayer, load_released, sinusoids
from wearcap.systems.ireplica.training import fit_temperature


def parameters(net: nn.Module) -> int:
    return sum(p.numel() for p in net.parameters())


def test_the_published_network_has_its_published_size():
    assert parameters(ContactTransformer(69)) == 21_944
    assert parameters(ContactTransformer(159)) == 24_824


def test_ours_is_no_larger():
    assert parameters(ContactSequence(102)) <= 21_944


def test_a_layer_is_pytorchs_own():
    torch.manual_seed(0)
    theirs = nn.TransformerEncoderLayer(32, 8, 32, 0.5, batch_first=True)
    ours = EncoderLayer(0.5)
    ours.load_state_dict(theirs.state_dict())
    x = torch.randn(5, FRAMES, 32)
    torch.testing.assert_close(ours.eval()(x), theirs.eval()(x), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("net", [ContactTransformer(12), ContactSequence(12)], ids=["published", "ours"])
def test_an_answer_depends_on_its_61_frames_alone(net):
    net.eval()
    pose = torch.randn(2, 130, 12)
    whole = net(pose)
    assert whole.shape == (2, 130 - 2 * REACH, 2, net.classes)
    for frame in (0, 33, 69):
        torch.testing.assert_close(net(pose[:, frame : frame + FRAMES])[:, 0], whole[:, frame], atol=1e-5, rtol=0)
    changed = pose.clone()
    changed[:, 20] += 1.0
    moved = (net(changed) - whole).abs().amax((0, 2, 3)) > 1e-6
    assert moved[:21].any()
    assert not moved[21:].any()  # frame 20 is no neighbour of frame REACH + 21


def test_ours_treats_both_hands_alike():
    net = ContactSequence(12).eval()
    pose = torch.randn(1, 80, 12)
    swapped = torch.cat([pose[..., 6:], pose[..., :6]], -1)
    torch.testing.assert_close(net(swapped), net(pose).flip(2))


def test_attention_runs_over_time_or_by_switch_over_the_batch():
    torch.manual_seed(0)
    net = ContactTransformer(12).eval()
    windows = torch.randn(4, FRAMES, 12)
    torch.testing.assert_close(net(windows)[:2], net(windows[:2]), atol=1e-5, rtol=0)
    net.batch_axis = True
    assert (net(windows)[:2] - net(windows[:2])).abs().max() > 1e-4


def test_ours_must_fit_61_frames():
    with pytest.raises(ValueError, match="reach 32 frames, not 30"):
        ContactSequence(12, dilations=(1, 2, 4, 7))
    with pytest.raises(WearcapError, match="2 classes"):
        ContactTransformer(69, classes=2)


class Released(nn.Module):
    """Modules and names of the released code's network, rebuilt from its description."""

    def __init__(self, inputs: int):
        super().__init__()
        layer = nn.TransformerEncoderLayer(32, 8, 32, 0.5)
        self.transformer_encoder = nn.TransformerEncoder(layer, 3, enable_nested_tensor=False)
        self.encoder = nn.Linear(inputs, 32)
        self.decoder = nn.Sequential(nn.Linear(32, 2), nn.ReLU())
        self.aggregator = nn.Linear(122, 2)

    def forward(self, windows):
        x = self.encoder(windows) * 32**0.5
        x = self.transformer_encoder(x + sinusoids(len(x))[:, None])
        return self.aggregator(self.decoder(x).flatten(1))


def released_state(net: Released) -> dict[str, torch.Tensor]:
    state = {f"model.{name}": value for name, value in net.state_dict().items()}
    return state | {"model.pos_encoder.pe": sinusoids(5000)[:, None]}


@pytest.mark.parametrize("inputs", [69, 159])
def test_released_checkpoints_give_their_numbers_with_the_switch(tmp_path, inputs):
    torch.manual_seed(0)
    theirs = Released(inputs).eval()
    torch.save({"state_dict": released_state(theirs), "epoch": 3}, tmp_path / "released.ckpt")
    ours = load_released(tmp_path / "released.ckpt")
    windows = torch.randn(7, FRAMES, inputs)
    torch.testing.assert_close(ours(windows)[:, 0, :, 0], theirs(windows), atol=1e-5, rtol=1e-5)
    assert not load_released(tmp_path / "released.ckpt", batch_axis=False).batch_axis


def test_a_wrong_checkpoint_names_what_is_missing_and_unexpected(tmp_path):
    state = released_state(Released(69))
    path = tmp_path / "wrong.ckpt"
    del state["model.aggregator.bias"]
    state["model.gru.weight_ih_l0"] = torch.zeros(96, 32)
    torch.save({"state_dict": state}, path)
    with pytest.raises(WearcapError, match=r"1 missing \(aggregator.bias\) and 1 unexpected \(model.gru.weight"):
        load_released(path)
    state = released_state(Released(69))
    state["model.pos_encoder.pe"] = torch.zeros(61, 1, 32)
    torch.save({"state_dict": state}, path)
    with pytest.raises(WearcapError, match="not the sinusoids"):
        load_released(path)
    torch.save({"state_dict": {"head.weight": torch.zeros(3, 4)}}, path)
    with pytest.raises(WearcapError, match="not the weights of iReplica's contact network"):
        load_released(path)


def test_a_planted_temperature_is_found():
    torch.manual_seed(0)
    logits = 2 * torch.randn(20000, 2)
    truth = torch.rand(20000, 2) < (logits / torch.tensor([2.5, 0.7])).sigmoid()
    assert fit_temperature(logits, truth).tolist() == pytest.approx([2.5, 0.7], rel=0.06)
    assert fit_temperature(logits, torch.zeros_like(truth)).tolist() == [1.0, 1.0]
