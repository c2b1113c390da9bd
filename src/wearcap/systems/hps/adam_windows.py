"""The thesis's solver (§4.3.1): Adam over windows of 100 frames, neighbours sharing one frame."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.systems.hps.energy import HpsData, HpsEnergy, HpsState, Solution, energy_terms


@dataclass(frozen=True)
class AdamSettings:
    """Settings of Adam: window and step of the thesis, learning rate and number of steps of the released code."""

    window: int = 100
    advance: int = 99
    steps: int = 500
    learning_rate: float = 1e-3
    full_mesh: bool = True
    """Whether the whole body is skinned at each step (thesis); False: only the patches, with the same result."""
    dtype: torch.dtype = torch.float32

    def __post_init__(self):
        if not 0 < self.advance < self.window:
            what = f"windows of {self.window} frames that advance by {self.advance}"
            raise WearcapError(what, expected="less than a window: neighbours share a frame")


def solve_adam_windows(energy: HpsEnergy, data: HpsData, settings: AdamSettings = AdamSettings()) -> Solution:
    """Minimise window after window; a window's first frame is fixed to the previous window's last."""
    data = data.to(settings.dtype)
    state = data.start
    theta, R, t = state.theta.clone(), state.R_world_root.clone(), state.t_world_root.clone()
    histories, begin = [], 0
    while True:
        stop = min(begin + settings.window, len(data))
        window = slice(begin, stop)
        start = HpsState(theta[window], R[window], t[window])
        solved, history = _solve_window(energy, data[window], start, begin > 0, settings)
        theta[window], R[window], t[window] = solved.theta, solved.R_world_root, solved.t_world_root
        histories.append(history)
        if stop == len(data):
            break
        begin += settings.advance
    mean = [{name: sum(step[name] for step in steps) / len(steps) for name in steps[0]} for steps in zip(*histories)]
    return Solution(HpsState(theta.double(), R.double(), t.double()), mean, f"{settings.steps} steps per window")


def _solve_window(
    energy: HpsEnergy, data: HpsData, start: HpsState, fixed_first: bool, settings: AdamSettings
) -> tuple[HpsState, list[dict[str, float]]]:
    theta = start.theta.clone().requires_grad_()
    turn = torch.zeros_like(start.t_world_root).requires_grad_()
    t = start.t_world_root.clone().requires_grad_()
    adam = torch.optim.Adam([theta, turn, t], lr=settings.learning_rate)
    free = torch.ones(len(data), 1, dtype=t.dtype)
    if fixed_first:
        free[0] = 0.0

    def state() -> HpsState:
        return HpsState(
            start.theta + free[..., None] * (theta - start.theta),
            start.R_world_root @ rotation.exp(free * turn),
            start.t_world_root + free * (t - start.t_world_root),
        )

    history = []
    for _ in range(settings.steps):
        adam.zero_grad()
        terms = energy_terms(energy, data, state(), full_mesh=settings.full_mesh)
        total: Float[Tensor, ""] = torch.stack(list(terms.values())).sum()
        total.backward()
        adam.step()
        history.append({name: value.item() for name, value in terms.items()} | {"total": total.item()})
    with torch.no_grad():
        return HpsState(*(part.clone() for part in vars(state()).values())), history
