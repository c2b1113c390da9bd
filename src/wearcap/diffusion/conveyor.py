"""Conveyor inference (ECHO §3.3): a queue whose noise level grows along it; frames enter as noise and leave clean.

All batch items take in a frame at the same time; a recording that has ended adds padding.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.diffusion.process import add_noise, posterior_step
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError

STEPS = ("posterior", "redraw")
Denoise = Callable[
    [Float[Tensor, "batch frame feature"], Float[Tensor, "batch frame modality"]], Float[Tensor, "batch frame feature"]
]
"""x̂0 from x_t and its noise levels, for all frames on the conveyor."""
Correct = Callable[[Float[Tensor, "batch frame feature"]], Float[Tensor, "batch frame feature"]]
"""Corrects x̂0, as guidance does."""


@dataclass(frozen=True)
class RollingSchedule:
    """Schedule of a conveyor: `context` clean frames are kept before the ramp, on which every frame is denoised
    `per_frame` times per frame that enters. Raises WearcapError for a context without a ramp and for unknown steps."""

    window: int
    context: int
    per_frame: int = 1
    spacing: float = 1.0
    """Exponent of the levels: 1 spaces them evenly, more takes smaller steps at low noise levels."""
    eta: float = 1.0
    """Stochasticity of the steps: 1 samples the posterior, 0 is DDIM."""
    step: str = "posterior"
    """Update rule, one of `STEPS`; "redraw" adds fresh noise to x̂0 in every step, as ECHO eq. 11 is printed."""

    lead: tuple[float, ...] = ()
    """Share by which each modality's ramp is shorter than the frame's: it is denoised before the others; none: by nothing."""

    def __post_init__(self):
        if not all(0 <= lead < 1 for lead in self.lead):
            raise WearcapError(f"leads of {self.lead}", expected="from 0 to less than 1 each")
        if not 0 <= self.context < self.window:
            what = f"a context of {self.context} frames in a window of {self.window}"
            raise WearcapError(what, expected=f"from 0 to {self.window - 1}")
        if self.per_frame < 1:
            raise WearcapError(f"{self.per_frame} steps per frame", expected="at least 1")
        if self.step not in STEPS:
            raise WearcapError(f"no step {self.step!r}", expected=f"one of {', '.join(STEPS)}")

    @property
    def ramp(self) -> int:
        """Number of frames that are neither context nor clean; a pose is final when `ramp` - 1 frames have followed."""
        return self.window - self.context

    @property
    def steps(self) -> int:
        """Total number of denoising steps of a frame (ECHO: 100)."""
        return self.ramp * self.per_frame

    def levels(self, age: Int64[Tensor, "frame"]) -> Float[Tensor, "frame #modality"]:
        """Noise levels of frames that have been denoised `age` times: 1 for new frames, 0 for clean ones."""
        ramps = 1 - torch.tensor(self.lead or (0.0,))
        return (1 - age[:, None] / self.steps / ramps).clamp(0, 1) ** self.spacing


@dataclass(frozen=True)
class Observation:
    """Observed and absent modalities of the frames on a conveyor, which are not denoised."""

    observed: Float[Tensor, "batch frame feature"]
    is_observed: Bool[Tensor, "batch frame modality"]
    """Modalities that are fixed to `observed`, at level 0."""
    is_absent: Bool[Tensor, "batch frame modality"]
    """Modalities that do not exist, such as the object without an object; they remain noise at level 1."""


class Conveyor:
    """The frames of several batch items, the oldest first; at most a window."""

    def __init__(self, rolling: RollingSchedule, schedule: Schedule, sizes: tuple[int, ...], items: int):
        """`sizes`: number of features of each modality; `items`: batch size."""
        self.rolling, self.schedule, self.sizes = rolling, schedule, sizes
        self.x = torch.zeros(items, 0, sum(sizes))
        self.age = torch.zeros(0, dtype=torch.long)
        self.level = torch.zeros(items, 0, len(sizes))
        """Current noise level of each frame's modalities."""
        self._observed = torch.zeros(items, 0, len(sizes), dtype=torch.bool)
        self._modality = torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes))

    def push(self, noise: Float[Tensor, "batch feature"]) -> bool:
        """Add a new frame of noise; returns whether the oldest frame was removed for it."""
        full = len(self.age) == self.rolling.window
        self.x = torch.cat([self.x[:, int(full) :], noise[:, None].to(self.x)], 1)
        self.age = torch.cat([self.age[int(full) :], self.age.new_zeros(1)])
        new = self.level.new_ones(len(self.level), 1, len(self.sizes))
        self.level = torch.cat([self.level[:, int(full) :], new], 1)
        self._observed = torch.cat([self._observed[:, int(full) :], new < 1], 1)
        return full

    def run(
        self,
        denoise: Denoise,
        observation: Observation,
        noise: Float[Tensor, "step batch frame feature"],
        correct: Correct | None = None,
    ) -> None:
        """Take the steps between two frames; `noise` has the noise of each.

        A modality that was absent goes from noise to its frame's level in one step; one that becomes absent or is no
        longer observed becomes noise, except in final frames.
        """
        lost = self._observed & ~observation.is_observed & (self.age < self.rolling.steps)[:, None]
        observed, gone = self.wide(observation.is_observed), (observation.is_absent & (self.level < 1)) | lost
        self._observed = observation.is_observed
        self.x = torch.where(self.wide(gone), noise[0], self.x)
        self.level = torch.where(observation.is_observed, 0.0, torch.where(gone, 1.0, self.level))
        for fresh in noise:
            due = self.rolling.levels(self.age + 1).expand_as(self.level)
            level, then = (self.level, torch.where(observation.is_absent, self.level, torch.minimum(due, self.level)))
            self.x = torch.where(observed, observation.observed, self.x)
            x0_hat = denoise(self.x, level)
            if correct is not None:
                x0_hat = correct(x0_hat)
            now, after = self.wide(level), self.wide(then)
            if self.rolling.step == "redraw":
                moved = add_noise(x0_hat, fresh, after, self.schedule)
                self.x = torch.where(observed, observation.observed, torch.where(after < now, moved, self.x))
            else:
                self.x = posterior_step(self.x, x0_hat, now, after, fresh, self.schedule, self.rolling.eta)
            self.level, self.age = then, (self.age + 1).clamp_max(self.rolling.steps)

    @property
    def clean(self) -> int:
        """Number of final frames."""
        return int((self.age >= self.rolling.steps).sum())

    def wide(self, value: Tensor) -> Tensor:
        """Values per modality repeated for each of its features."""
        return value.index_select(-1, self._modality)
