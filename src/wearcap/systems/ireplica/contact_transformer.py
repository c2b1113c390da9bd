"""The published contact network of iReplica (thesis §5.3.2): a small transformer over windows of 61 poses.

A window yields one prediction, for its middle frame. 21,944 parameters for 69 inputs, 24,824 for 159.
"""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.errors import WearcapError
from wearcap.models.weights import load_weights, read_weights
from wearcap.systems.ireplica.contact_prediction import FRAMES, ContactNetwork

_WIDTH, _HEADS, _LAYERS, _HANDS = 32, 8, 3, 2


class Dropout(nn.Module):
    """nn.Dropout with a mask of random bytes: six times as fast on a CPU, where masks took half of a training step.

    The share that is dropped is a multiple of 1/256.
    """

    def __init__(self, share: float):
        super().__init__()
        self.least = round(256 * share)

    def forward(self, x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        if not self.training or self.least == 0:
            return x
        words = torch.empty(-(-x.numel() // 8), dtype=torch.int64, device=x.device).random_(-(2**63), None)
        kept = words.view(torch.uint8)[: x.numel()].view(x.shape) >= self.least
        return x * (kept * (256 / (256 - self.least)))


class Attention(nn.Module):
    """Multi-head self-attention, its parameters named and shaped as in nn.MultiheadAttention."""

    def __init__(self, dropout: float):
        super().__init__()
        self.dropout = Dropout(dropout)
        self.in_proj_weight = nn.Parameter(nn.init.xavier_uniform_(torch.empty(3 * _WIDTH, _WIDTH)))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * _WIDTH))
        self.out_proj = nn.Linear(_WIDTH, _WIDTH)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, x: Float[Tensor, "sequence token width"]) -> Float[Tensor, "sequence token width"]:
        projected = F.linear(x, self.in_proj_weight, self.in_proj_bias)
        q, k, v = projected.unflatten(-1, (3, _HEADS, -1)).permute(2, 0, 3, 1, 4)
        if self.training:
            weights = (q / math.sqrt(q.shape[-1]) @ k.transpose(-1, -2)).softmax(-1)
            attended = self.dropout(weights) @ v
        else:
            attended = F.scaled_dot_product_attention(q, k, v)
        return self.out_proj(attended.transpose(1, 2).flatten(2))


class EncoderLayer(nn.Module):
    """nn.TransformerEncoderLayer's post-norm layer, without its fused kernel, which cannot be exported."""

    def __init__(self, dropout: float):
        super().__init__()
        self.self_attn = Attention(dropout)
        self.linear1, self.linear2 = nn.Linear(_WIDTH, _WIDTH), nn.Linear(_WIDTH, _WIDTH)
        self.norm1, self.norm2 = nn.LayerNorm(_WIDTH), nn.LayerNorm(_WIDTH)
        self.dropout = Dropout(dropout)

    def forward(self, x: Float[Tensor, "sequence token width"]) -> Float[Tensor, "sequence token width"]:
        x = self.norm1(x + self.dropout(self.self_attn(x)))
        return self.norm2(x + self.dropout(self.linear2(self.dropout(self.linear1(x).relu()))))


class ContactTransformer(ContactNetwork):
    """Linear 69→32, sinusoidal positions, 3 post-norm layers of 8 heads, 32→2 and ReLU per frame, 61·2→2 in the end.

    `batch_axis`: attend over the windows of a batch instead of over their frames, with positional encoding along that
    axis, as the released code does by mistake. Predictions then depend on which windows share a batch; the switch
    exists to reproduce the released checkpoints' numbers.
    """

    frames_per_pass = 100

    def __init__(self, inputs: int = 69, classes: int = 1, dropout: float = 0.5, batch_axis: bool = False):
        super().__init__(classes)
        if classes != 1:
            what = f"the published contact network for {classes} classes of interaction"
            fix = "Train one network per class, as the thesis does, or model=contact_sequence."
            raise WearcapError(what, expected="one class", fix=fix)
        self.inputs, self.batch_axis = inputs, batch_axis
        self.encoder = nn.Linear(inputs, _WIDTH)
        self.layers = nn.ModuleList(EncoderLayer(dropout) for _ in range(_LAYERS))
        self.decoder = nn.Linear(_WIDTH, _HANDS)
        self.aggregator = nn.Linear(FRAMES * _HANDS, _HANDS)
        self.dropout = Dropout(dropout)

    def forward(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        windows = pose.unfold(1, FRAMES, 1).transpose(-1, -2).flatten(0, 1)
        x = self.encoder(windows) * math.sqrt(_WIDTH)
        if self.batch_axis:
            x = x.transpose(0, 1)
        x = self.dropout(x + sinusoids(x.shape[1]).to(x))
        for layer in self.layers:
            x = layer(x)
        if self.batch_axis:
            x = x.transpose(0, 1)
        return self.aggregator(self.decoder(x).relu().flatten(1)).view(len(pose), -1, _HANDS, 1)


def sinusoids(length: int) -> Float[Tensor, "place width"]:
    """Sinusoidal positional encoding, wavelengths from 2π to 20,000π (Vaswani et al. 2017): sines even, cosines odd."""
    frequency = 10000.0 ** (-torch.arange(0, _WIDTH, 2) / _WIDTH)
    angle = torch.arange(length)[:, None] * frequency
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(1)


def load_released(path: str | Path, batch_axis: bool = True) -> ContactTransformer:
    """Load the published network of a checkpoint of the released code, in evaluation mode. Raises WearcapError that
    names missing or unexpected tensors and those of another size."""
    released = read_weights(path)
    # Encoder layers are recognised by `layers.0…` after any prefix, the linear layers around them by their shapes.
    by_shape = {(_HANDS, _WIDTH): "decoder", (_HANDS, FRAMES * _HANDS): "aggregator"}
    module = {}
    for name, value in released.items():
        if name.endswith(".weight") and value.ndim == 2 and "layers." not in name:
            found = "encoder" if value.shape[0] == _WIDTH else by_shape.get(tuple(value.shape))
            if found is not None:
                module[name.removesuffix(".weight")] = found
    tensors = {}
    for name, value in released.items():
        owner, _, kind = name.rpartition(".")
        if "layers." in name:
            name = name[name.index("layers.") :]
        elif owner in module:
            name = f"{module[owner]}.{kind}"
        if kind != "pe":
            tensors[name] = value
        elif not torch.allclose(value.flatten(0, -2), sinusoids(value.numel() // _WIDTH), atol=1e-5):
            raise WearcapError(f"the positions {name!r} are not the sinusoids of this network", where=path)
    inputs = tensors["encoder.weight"].shape[1] if "encoder.weight" in tensors else 69
    network = ContactTransformer(inputs, batch_axis=batch_axis)
    tensors["temperature"] = network.temperature
    load_weights(network, tensors, name="iReplica's contact network", where=path)
    return network.eval()
