"""HMD²'s denoising steps at a fixed sequence of levels, in any runtime."""

from contextlib import AbstractContextManager

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.runtime.graphs import chosen, run_of, undisturbed
from wearcap.systems.hmd2.model import MotionDenoiser


class StepRunner:
    """x̂0 at a fixed sequence of levels, for any batch size. The network's weights must not change while it is used."""

    def __init__(
        self, net: MotionDenoiser, levels: Float[Tensor, "step"], runtime: str = "eager", precision: str = "float32"
    ):
        """Raises WearcapError for a runtime or precision that is unknown, not installed, or that do not go together."""
        device = net.motion_normalizer.mean.device
        self.net, (self.runtime, precision) = net, chosen(runtime, precision, device)
        with torch.inference_mode():
            plan = run_of(net.graphs()["plan"])
            self._plans = [plan(level=level.reshape(1, 1)) for level in levels.to(device)]
        self._step = run_of(net.graphs()["step"], self.runtime, precision)

    def __call__(
        self,
        number: int,
        x_t: Float[Tensor, "batch time motion"],
        encoded: Float[Tensor, "batch token width"],
        valid: Bool[Tensor, "batch time"],
        last: Float[Tensor, "batch time motion"] | None = None,
    ) -> Float[Tensor, "batch time motion"]:
        """x̂0 at level `number` of the sequence."""
        more = {"last": torch.zeros_like(x_t) if last is None else last} if self.net.self_conditioning else {}
        return self._step(x_t=x_t, plan=self._plans[number], encoded=encoded, valid=valid, **more)

    def undisturbed(self) -> AbstractContextManager[None]:
        """A context for small batches in which PyTorch's threads leave the cores to ONNX Runtime's."""
        return undisturbed(self.runtime == "onnx")
