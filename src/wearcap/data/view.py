"""Which hands a head-mounted device finds in training windows: those in its cameras' view, now and then."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.data.batch import Batch
from wearcap.geometry.rigid import Rigid


@dataclass(frozen=True)
class HandsInView:
    """Hands are found inside a field of view that each window draws, in bursts (EgoPoser's and HaMoS' idea); controllers,
    which are tracked wherever they are, are a share of the windows."""

    everywhere: float = 0.2
    """Share of windows whose hands are tracked wherever they are."""
    absent: float = 0.1
    """Share of hands that are not found in a window at all, as controllers that sleep."""
    across_deg: tuple[float, float] = (40.0, 65.0)
    upright_deg: tuple[float, float] = (30.0, 55.0)
    """Smallest and largest half angle of the field of view, across and upright."""
    down_deg: tuple[float, float] = (0.0, 30.0)
    """By how much its middle is below the head's axis."""
    least: float = 0.1
    """Smallest share of the time in view in which a hand is found."""
    burst_s: tuple[float, float] = (0.1, 1.5)
    """Shortest and longest stretch that is found or lost as a whole."""

    def __call__(
        self, T_world_head: Rigid, t_world_wrist: Float[Tensor, "batch time hand 3"], batch: Batch
    ) -> Bool[Tensor, "batch time hand"]:
        """Which hands are found in the frames of a batch."""
        draws, hands = batch.draws, t_world_wrist.shape[2]

        def drawn(name: str, least: float, most: float) -> Float[Tensor, "batch 1 1"]:
            return least + (most - least) * draws.uniform(f"hands {name}")[:, None, None]

        across, upright, down = (
            drawn(name, *limits).deg2rad()
            for name, limits in (("across", self.across_deg), ("upright", self.upright_deg), ("down", self.down_deg))
        )
        away = (T_world_head.R.mT[:, :, None] @ (t_world_wrist - T_world_head.t[:, :, None])[..., None])[..., 0]
        forward, left, up = away.unbind(-1)
        inside = (torch.atan2(left, forward).abs() < across) & ((torch.atan2(up, forward) + down).abs() < upright)
        always = drawn("everywhere", 0.0, 1.0) < self.everywhere
        length = drawn("burst", *self.burst_s)[:, 0] * batch.fps
        frames = torch.arange(batch.count, device=batch.device) + draws.uniform("hands begin", 1) * length
        burst = (frames / length).long()[..., None].expand(-1, -1, hands)
        most = 2 + int(batch.count / (self.burst_s[0] * batch.fps))
        found = draws.uniform("hands found", most, hands).gather(1, burst) < drawn("share", self.least, 1.0)
        there = draws.uniform("hands absent", 1, hands) >= self.absent
        return (always | (inside & found)) & there
