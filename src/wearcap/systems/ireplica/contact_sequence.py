"""Contact network for whole sequences (ours): dilated temporal convolutions over both hands' views of the pose."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.models.layers import Normalizer
from wearcap.systems.ireplica.contact_prediction import REACH, ContactNetwork

_HANDS = 2


class _GatedBlock(nn.Module):
    """Residual block: dilated depthwise convolution without padding (time shrinks), then a gated linear unit."""

    def __init__(self, width: int, taps: int, dilation: int, dropout: float):
        super().__init__()
        self.taps, self.dilation = taps, dilation
        self.norm = nn.LayerNorm(width)
        self.kernel = nn.Parameter(torch.randn(taps, width) / taps**0.5)
        self.mix = nn.Linear(width, 2 * width)
        self.dropout = nn.Dropout(dropout)

    @property
    def reach(self) -> int:
        return self.taps // 2 * self.dilation

    def forward(self, x: Float[Tensor, "batch time width"]) -> Float[Tensor, "batch out width"]:
        out = x.shape[1] - 2 * self.reach
        normal = self.norm(x)
        # Tap by tap: on the CPU faster than a grouped convolution of so few channels.
        seen = sum(normal[:, i * self.dilation : i * self.dilation + out] * self.kernel[i] for i in range(self.taps))
        return x[:, self.reach : self.reach + out] + self.dropout(F.glu(self.mix(seen), -1))


class ContactSequence(ContactNetwork):
    """Gated dilated convolutions over each hand's view of the pose (`HandViews`) and its temporal differences.

    Both hands share weights: the right hand's view is mirrored. Differences are central, over `strides` frames to both
    sides. A prediction depends on exactly the 61 frames around it, however many frames are computed in one pass.
    """

    frames_per_pass = 18000

    def __init__(
        self,
        inputs: int,
        classes: int = 2,
        width: int = 40,
        taps: int = 5,
        dilations: tuple[int, ...] | list[int] = (1, 2, 4, 6),
        strides: tuple[int, ...] | list[int] = (1, 4),
        dropout: float = 0.1,
    ):
        super().__init__(classes)
        self.inputs, self.strides = inputs, tuple(strides)
        derived = inputs // _HANDS * (1 + len(self.strides))
        self.normalizer = Normalizer(derived)
        self.widen = nn.Linear(derived, width)
        self.blocks = nn.ModuleList(_GatedBlock(width, taps, dilation, dropout) for dilation in dilations)
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, classes)
        reach = max(self.strides) + sum(block.reach for block in self.blocks)
        if reach != REACH:
            raise ValueError(f"strides and dilations reach {reach} frames, not {REACH}")

    def _derived(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "view out derived"]:
        """Views of both hands and their differences; batch and hand share the first axis."""
        view = pose.unflatten(-1, (_HANDS, -1)).transpose(1, 2).flatten(0, 1)
        margin, last = max(self.strides), view.shape[1]
        parts = [view[:, margin : last - margin]]
        parts += [
            view[:, margin + s : last - margin + s] - view[:, margin - s : last - margin - s] for s in self.strides
        ]
        return torch.cat(parts, -1)

    def normalize_on(self, pose: Float[Tensor, "batch time feature"]) -> None:
        rows = self._derived(pose).flatten(0, 1)
        self.normalizer.set(rows.mean(0), rows.std(0).clamp_min(1e-3))

    def forward(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        x = self.widen(self.normalizer(self._derived(pose)))
        for block in self.blocks:
            x = block(x)
        return self.head(self.norm(x)).unflatten(0, (-1, _HANDS)).transpose(1, 2)
