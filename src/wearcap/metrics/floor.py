"""Error of an estimated floor height against the ground below standing feet."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def stood_on(
    sole_height: Float[Tensor, "time foot"], contact: Bool[Tensor, "time foot"]
) -> tuple[Float[Tensor, "time"], Float[Tensor, "time"]]:
    """Lowest and highest ground (m) that the feet stand on, or stood on last.

    `sole_height` is the height of each foot's lowest point. On level ground and slopes both are nearly equal; on stairs
    they differ by a step. Before its first contact a foot uses the ground of that contact; a foot without contact is
    ignored.
    """
    ground = []
    frames = torch.arange(len(contact))
    for foot in range(contact.shape[1]):
        stands = contact[:, foot].nonzero()[:, 0]
        if not len(stands):
            continue
        latest = stands[(torch.searchsorted(stands, frames, right=True) - 1).clamp_min(0)]
        ground.append(sole_height[latest, foot])
    if not ground:
        nowhere = torch.full((len(contact),), torch.nan)
        return nowhere, nowhere
    both = torch.stack(ground)
    return both.amin(0), both.amax(0)


def floor_error_m(
    height: Float[Tensor, "time"], low: Float[Tensor, "time"], high: Float[Tensor, "time"]
) -> Float[Tensor, "time"]:
    """Distance (m) of a floor's height from the interval between the lowest and the highest ground stood on."""
    return torch.maximum(low - height, height - high).clamp_min(0)
