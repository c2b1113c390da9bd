"""Foot contacts for suits that report none (thesis §4.2.4), from the feet's speed. The papers give no thresholds: these
are ours."""

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import require_rising
from wearcap.recording.motion import Motion

_SPEED = (0.1, 0.15)
"""Speed of a patch (m/s): contact begins below the first threshold and ends above the second."""
_MAX_HEIGHT_M = 0.35
"""Largest height above the lowest patch (two stairs); higher feet are in the air."""
_SHORTEST_S = 0.07
"""Shorter contacts, and shorter gaps between contacts, are removed."""


def contacts_from_motion(motion: Motion) -> Bool[Tensor, "time patch"]:
    """Contacts of `FOOT_PATCHES`: each patch from its own speed. The skeleton needs the sites of that name."""
    missing = [patch for patch in FOOT_PATCHES if patch not in motion.skeleton.sites]
    if missing:
        what = f"skeleton {motion.skeleton.name!r} has no {missing[0]!r}"
        raise WearcapError(what, expected=f"sites {', '.join(FOOT_PATCHES)}")
    if len(motion) < 3:
        raise WearcapError(f"a motion of {len(motion)} frames", expected="three or more")
    require_rising(motion.timestamps)
    patches = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double()
    between = (patches.diff(dim=0) / motion.timestamps.diff()[:, None, None]).norm(dim=-1)
    # A patch that stands in this frame has stood since the last one or will until the next.
    speed = torch.minimum(torch.cat([between[:1], between]), torch.cat([between, between[-1:]]))
    # Slow from where the speed falls below the first threshold until it rises above the second.
    frame = torch.arange(1, len(speed) + 1)[:, None].expand_as(speed)
    below = torch.where(speed < _SPEED[0], frame, 0).cummax(0).values
    above = torch.where(speed > _SPEED[1], frame, 0).cummax(0).values
    low = patches[..., 2] - patches[..., 2].amin(1, keepdim=True) < _MAX_HEIGHT_M
    return steady((below > above) & low, motion.fps)


def steady(contact: Bool[Tensor, "time patch"], fps: float) -> Bool[Tensor, "time patch"]:
    """Contacts with short gaps closed, then short contacts dropped."""
    window = np.ones((max(int(np.ceil(_SHORTEST_S * fps)), 1), 1), bool)
    padded = np.pad(contact.numpy(), ((len(window), len(window)), (0, 0)), mode="edge")
    padded = scipy.ndimage.binary_opening(scipy.ndimage.binary_closing(padded, window), window)
    return torch.from_numpy(padded[len(window) : -len(window)])
