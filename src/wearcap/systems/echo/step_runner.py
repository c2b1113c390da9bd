"""ECHO's denoising steps in any runtime: level-dependent activations are cached."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from wearcap.runtime.graphs import chosen, run_of
from wearcap.systems.echo.model import EchoDenoiser

MOST_ROWS = 1024
"""Level triples whose plans are cached: a queue has one per step and combination of observed and absent modalities."""
MOST_WINDOWS = 8
"""Windows of levels whose plans are cached: a queue in steady state repeats as many as it has steps per frame."""


class EchoPlans:
    """Cache of a network's level-dependent activations (`EchoDenoiser.plan`), computed once per triple of levels.

    The network's weights must not change. Triples repeat between frames, while the levels of whole windows rarely do
    when an object enters: its first frame moves through the window.
    """

    def __init__(self, net: EchoDenoiser):
        self._plan, self._device = run_of(net.graphs()["plan"]), net.motion_normalizer.mean.device
        self._number: dict[tuple[float, ...], int] = {}
        self._rows: Tensor | None = None
        self._windows: dict[bytes, Tensor] = {}

    @torch.no_grad()
    def __call__(self, level: Float[Tensor, "batch frame modality"]) -> Float[Tensor, "#batch frame column"]:
        """Plans of all batch items, or of one if all have the same levels. Levels are on the CPU."""
        if len(level) > 1 and (level == level[:1]).all():
            level = level[:1]
        key = bytes(str(tuple(level.shape)), "ascii") + level.numpy().tobytes()
        if key not in self._windows:
            if len(self._windows) >= MOST_WINDOWS:
                self._windows.pop(next(iter(self._windows)))
            self._windows[key] = self._computed(level)
        return self._windows[key]

    def _computed(self, level: Float[Tensor, "batch frame modality"]) -> Float[Tensor, "batch frame column"]:
        triples = [tuple(row) for row in level.flatten(0, 1).tolist()]
        if len(self._number) > MOST_ROWS:
            self._number.clear()
            self._rows = None
        fresh = list(dict.fromkeys(triple for triple in triples if triple not in self._number))
        if fresh:
            rows = self._plan(level=torch.tensor(fresh, device=self._device)[:, None])[:, 0]
            self._number |= {triple: len(self._number) + k for k, triple in enumerate(fresh)}
            self._rows = rows if self._rows is None else torch.cat([self._rows, rows])
        assert self._rows is not None
        take = torch.tensor([self._number[triple] for triple in triples], device=self._device)
        return self._rows[take].unflatten(0, level.shape[:2])


class EchoRunner:
    """Computes x̂0 of windows. The network's weights must not change while it is in use."""

    def __init__(self, net: EchoDenoiser, runtime: str = "eager", precision: str = "float32"):
        """Raises WearcapError for a runtime or precision that is unknown, not installed, or not for the device."""
        self.net, self._device = net, net.motion_normalizer.mean.device
        self.runtime, precision = chosen(runtime, precision, self._device)
        graphs, self.plans = net.graphs(), EchoPlans(net)
        self._step, self._encode = (run_of(graphs[name], self.runtime, precision) for name in ("step", "conditions"))
        self._window = None if self.runtime == "eager" and not net.exported else net.window
        self._whole_batches = self.runtime == "onnx" or net.exported

    def begin(
        self,
        condition: Float[Tensor, "batch time condition"],
        scene_object: Float[Tensor, "batch time embedded"],
        has_object: Bool[Tensor, "batch time"],
        valid: Bool[Tensor, "batch time"],
    ) -> Callable[[Tensor, Tensor], Tensor]:
        """x̂0 as a function of x_t "batch time feature" and levels "batch time modality", encoding conditions once.

        Inputs and outputs are on the CPU.
        """
        count = valid.shape[1]
        condition, scene_object, has_object, valid = map(self._whole, (condition, scene_object, has_object, valid))
        encoded = self._encode(condition=condition, scene_object=scene_object, has_object=has_object, valid=valid)

        def denoise(x_t: Tensor, level: Tensor) -> Tensor:
            x_t, plan = self._whole(x_t), self.plans(self._padded(level))
            plan = plan.expand(len(x_t), -1, -1) if self._whole_batches else plan
            return self._step(x_t=x_t, plan=plan, encoded=encoded, valid=valid)[:, :count].float().cpu()

        return denoise

    def _whole(self, value: Tensor) -> Tensor:
        """A tensor on the device, padded to a full window for runtimes with fixed shapes."""
        return self._padded(value).to(self._device)

    def _padded(self, value: Tensor) -> Tensor:
        more = 0 if self._window is None else self._window - value.shape[1]
        return F.pad(value, (0, 0) * (value.ndim - 2) + (0, more)) if more else value
