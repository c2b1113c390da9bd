"""HMD²'s overlapping windows: each continues the last one's prediction by a few frames (thesis eq. 6.5).

In the thesis every denoising step of a window overwrites the overlap with the last window's prediction (inpainting).
With small strides a window then accumulates its own errors. Ours (`inpaint` off) re-denoises each window from the same
noise, which is drawn per frame and moves along with its frame: successive windows' predictions for a frame differ only
by what the later window has seen since, and after the last final frame that difference fades out over `fade` frames.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn import functional as F

from wearcap.body.skeleton import FEET, Skeleton
from wearcap.data.features import body_size
from wearcap.diffusion.schedule import Schedule
from wearcap.runtime.windows import StretchWindows, appended, cut
from wearcap.systems.hmd2.conditions import Condition
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser


@dataclass(frozen=True, eq=False)
class DiffusionModel:
    """What a training gives a capture: the network, and what it was trained with."""

    net: MotionDenoiser
    features: HeadFeatures
    schedule: Schedule
    skeleton: Skeleton
    """Skeleton for recordings without one of their own."""
    fps: float
    conditions: Mapping[str, Condition] = field(default_factory=dict)
    """The network's conditions beside the head, in its order."""
    joint_dof: float | None = None
    """As of the motions that are captured."""


class Frames(NamedTuple):
    """Conditioning of some frames; a batch item is one wearer, recording or stretch of a recording."""

    timestamps: Float64[Tensor, "batch time"]
    R_world_head: Float[Tensor, "batch time 3 3"]
    t_world_head: Float[Tensor, "batch time 3"]
    floor_height: Float[Tensor, "batch time"]
    others: Float[Tensor, "batch time feature"]
    given: Bool[Tensor, "batch time condition"]
    valid: Bool[Tensor, "batch time"]
    """False where the head pose is missing and after a recording's end; other fields are any finite numbers there."""


class Predicted(NamedTuple):
    """What the last window predicted for its frames, and what each frame keeps from window to window."""

    R_parent_joint: Float[Tensor, "batch time joint 3 3"]
    foot_contact: Float[Tensor, "batch time foot"]
    joint_std: Float[Tensor, "batch time deviation"]
    noise: Float[Tensor, "batch time step feature"]
    """Noise of every sampling step."""


class WindowSampler(StretchWindows[Frames]):
    """Samples the windows of one batch item; memory is bounded by the window and the frames that wait.

    The first windows grow: they contain the frames so far, left-aligned, and the remaining frames are masked.
    """

    def __init__(self, features: HeadFeatures, skeleton: Skeleton, length: int, steps: int, seed: int):
        """`length`: most frames of a window; `steps`: denoising steps, each with noise of its own."""
        super().__init__(length)
        self.size = body_size(skeleton)
        deviations = features.motion_size - features.pose_size
        self._random, self._sizes = torch.Generator().manual_seed(seed), (steps, features.pose_size)
        self._rest = (
            torch.eye(3).expand(1, 1, features.joints, 3, 3),
            torch.zeros(1, 1, FEET),
            torch.zeros(1, 1, deviations),
        )
        self.predicted = self._unpredicted(0)
        self.waiting: Frames | None = None
        """Frames that no window contains yet."""

    def push(self, frames: Frames) -> None:
        """Take in any number of new frames."""
        self.waiting = appended(self.waiting, frames)

    def join(self, stride: int) -> None:
        """Go on to the next window by `stride` waiting frames; where there are fewer, the last one, not valid, stands in."""
        assert self.waiting is not None
        left, number = self.waiting.valid.shape[1], torch.arange(stride)
        fresh = cut(self.waiting, number.clamp_max(left - 1))
        self.waiting = cut(self.waiting, slice(stride, None)) if left > stride else None
        dropped = self.append(fresh._replace(valid=fresh.valid & (number < left)))
        self.predicted = appended(self.predicted, self._unpredicted(stride), dropped)

    def _unpredicted(self, count: int) -> Predicted:
        """New frames: identity rotations, no contact, and noise of their own, but for deviations, which are not diffused."""
        noise = torch.randn(1, count, *self._sizes, generator=self._random)
        noise = F.pad(noise, (0, self._rest[2].shape[-1]))
        return Predicted(*(part.repeat(1, count, *[1] * (part.ndim - 2)) for part in self._rest), noise)

    def finalize(self, lookahead: int) -> slice:
        assert self.frames is not None
        # Frames after a recording's end are not valid and never output.
        return super().finalize(lookahead + int((~self.frames.valid).sum()))

    def _poses(self, part: slice) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        R = self.predicted.R_parent_joint[0, part]
        return R, torch.zeros(len(R), 3), self.predicted.foot_contact[0, part], self.predicted.joint_std[0, part]


def blended(
    x0_hat: Float[Tensor, "batch time feature"],
    observed: Float[Tensor, "batch time feature"],
    is_observed: Bool[Tensor, "batch time"],
    fade: int,
) -> Float[Tensor, "batch time feature"]:
    """x̂0 overwritten by the observed frames; its offset at the last of them fades out over the next `fade` frames.

    The offset (its value and slope) follows a cubic Hermite curve to zero, so that neither the motion nor its velocity
    jumps. `fade` 0 leaves a jump.
    """
    whole = torch.where(is_observed[..., None], observed, x0_hat)
    if not fade:
        return whole
    number = torch.arange(x0_hat.shape[1], device=x0_hat.device)
    seam = (number * is_observed).amax(1)
    row = torch.arange(len(seam), device=seam.device)
    there, before = (is_observed[row, frame, None] for frame in (seam, seam - 1))
    difference = observed - x0_hat
    step = difference[row, seam] * there
    slope = (step - difference[row, seam - 1]) * (there & before)
    share = ((number - seam[:, None]) / fade).clamp(0, 1)[..., None]
    offset = (1 - share) ** 2 * ((1 + 2 * share) * step[:, None] + fade * share * slope[:, None])
    return torch.where(is_observed[..., None], whole, whole + offset * (number > seam[:, None])[..., None])
