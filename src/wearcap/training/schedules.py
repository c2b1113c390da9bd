"""Learning-rate schedules."""

import math
from collections.abc import Callable

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


def warmup_cosine(
    optimizer: Optimizer, warmup: int, total: int, floor: float = 0.01, elapsed: Callable[[], float] | None = None
) -> LambdaLR:
    """Linear rise over `warmup` steps, then half a cosine down to `floor` of the peak at the end of the budget: at step
    `total` (-1: no limit), or when `elapsed`, the share of the run's time that has passed, is 1, whichever comes first."""

    def factor(step: int) -> float:
        if step < warmup:
            return (step + 1) / warmup
        by_steps = (step - warmup) / max(1, total - warmup) if total >= 0 else 0.0
        progress = min(1.0, max(by_steps, elapsed() if elapsed is not None else 0.0))
        return floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * progress))

    return LambdaLR(optimizer, factor)
