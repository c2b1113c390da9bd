"""Foot contacts for suits that report none, from the feet's speed or sensors (thesis §4.2.4: "a peak in the
acceleration of the leg"). The papers give no thresholds: these are ours."""

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import require_rising
from wearcap.recording.motion import Motion
from wearcap.recording.recording import ImuStream

_SPEED = (0.1, 0.15)
"""Speed of a patch (m/s): contact begins below the first threshold and ends above the second, as for the next two."""
_GYRO = (0.35, 0.7)
"""Angular speed of a flat foot (rad/s)."""
_ACC = (3.0, 6.0)
"""Free acceleration of a flat foot (m/s²)."""
_MAX_HEIGHT_M = 0.35
"""Largest height above the lowest patch (two stairs); higher feet are in the air."""
_REACH_S = (0.15, 0.35)
"""Search ranges for the peak of heel strike before the foot is flat, and of push-off after it."""
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
    slow = _hysteresis(speed, _SPEED)
    low = patches[..., 2] - patches[..., 2].amin(1, keepdim=True) < _MAX_HEIGHT_M
    return _without_short(slow & low, _SHORTEST_S * motion.fps)


def contacts_from_imu(left: ImuStream, right: ImuStream) -> Bool[Tensor, "time patch"]:
    """Contacts of `FOOT_PATCHES` at the sensors' timestamps, from a sensor on each foot with the same timestamps.

    A foot lies flat while it neither turns nor accelerates. The heel touches from the acceleration's peak before
    that (heel strike), the toes until the peak after it (push-off). Raises WearcapError where gyro or acceleration
    is missing.
    """
    if not torch.equal(left.timestamps, right.timestamps):
        raise WearcapError("the two feet's sensors differ in their timestamps", expected="one clock and rate")
    require_rising(left.timestamps)
    fps = 1 / left.timestamps.diff().median().item()
    contacts = []
    for foot in (left, right):
        if foot.gyro_imu is None or foot.acc_world is None:
            what = "no angular rate or free acceleration"
            raise WearcapError(what, where=foot.joint, expected="gyro_imu and acc_world")
        gyro, acc = foot.gyro_imu.norm(dim=-1)[:, None], foot.acc_world.norm(dim=-1)[:, None]
        flat = _hysteresis(gyro, _GYRO) & _hysteresis(acc, _ACC)
        flat = _without_short(flat, _SHORTEST_S * fps)[:, 0].numpy()
        heel, toes, amount = flat.copy(), flat.copy(), acc[:, 0].numpy()
        edge = np.diff(np.concatenate([[0], flat.astype(np.int8), [0]]))
        before, after = (round(reach * fps) for reach in _REACH_S)
        # One turn per step walked.
        for start, stop in zip(np.nonzero(edge == 1)[0].tolist(), np.nonzero(edge == -1)[0].tolist()):
            first = max(start - before, 0)
            heel[first + int(amount[first : start + 1].argmax()) : start] = True
            last = min(stop + after, len(flat))
            toes[stop : stop + 1 + int(amount[stop:last].argmax()) if stop < last else stop] = True
        contacts.append(torch.from_numpy(np.stack([heel, toes], 1)))
    return torch.cat(contacts, 1)


def _hysteresis(value: Float[Tensor, "time column"], thresholds: tuple[float, float]) -> Bool[Tensor, "time column"]:
    """True from where a value falls below the first threshold until it rises above the second."""
    frame = torch.arange(1, len(value) + 1)[:, None].expand_as(value)
    below = torch.where(value < thresholds[0], frame, 0).cummax(0).values
    above = torch.where(value > thresholds[1], frame, 0).cummax(0).values
    return below > above


def _without_short(state: Bool[Tensor, "time column"], frames: float) -> Bool[Tensor, "time column"]:
    """Close gaps shorter than a number of frames, then drop contacts shorter than that."""
    window = np.ones((max(int(np.ceil(frames)), 1), 1), bool)
    padded = np.pad(state.numpy(), ((len(window), len(window)), (0, 0)), mode="edge")
    padded = scipy.ndimage.binary_opening(scipy.ndimage.binary_closing(padded, window), window)
    return torch.from_numpy(padded[len(window) : -len(window)])
