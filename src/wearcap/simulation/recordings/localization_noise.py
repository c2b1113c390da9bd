"""Camera poses as localisation in a map would find them, drawn from a statistical model without images.

Good frames are off by some centimetres, mostly depending on the view, so that the error persists while the view
does; bursts of frames are plainly wrong; and for seconds nothing is found at all, mostly in front of blank walls.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.recording import Localization
from wearcap.sensors.simulated import smooth_noise

VIEW_M, VIEW_DEG, VIEW_S = 0.8, 35.0, 12.0
"""Translation, rotation and time that change a view, and with it the lasting part of the error."""
BLANK_PULL = 3.0
"""Ratio of the outage rates at the blankest views and at rich ones."""


@dataclass(frozen=True)
class LocalizationNoise:
    """Statistics of localisation; values are drawn uniformly from the ranges once per recording."""

    position_m: tuple[float, float] = (0.03, 0.07)
    """Median position error of good frames."""
    rotation_deg: tuple[float, float] = (1.0, 2.0)
    """Median angle error of good frames."""
    lasting: float = 0.6
    """Share of the error's variance that persists while the view does."""
    outliers: tuple[float, float] = (0.05, 0.15)
    """Share of the found frames that are plainly wrong."""
    outlier_m: tuple[float, float] = (0.3, 5.0)
    burst_s: float = 0.8
    """Approximate duration of a burst of outliers."""
    lost: tuple[float, float] = (0.02, 0.06)
    """Share of all frames in outages."""
    outage_s: tuple[float, float] = (1.0, 60.0)
    misjudged: float = 0.2
    """Share of the outliers whose confidence is that of good frames."""


def localize_statistically(
    path: Trajectory, noise: LocalizationNoise, rng: np.random.Generator, texture: Float[Tensor, "time"] | None = None
) -> Localization:
    """Localisation of a camera along its true path (OpenCV axes in the world, an even frame rate).

    `texture` is the amount of texture in each frame's view (any unit): outages come where it is least. Frames that
    are not found have confidence 0, an identity rotation and position 0.
    """
    count = len(path.timestamps)
    fps = (count - 1) / (path.timestamps[-1] - path.timestamps[0]).item()
    median_m, median_deg = rng.uniform(*noise.position_m), rng.uniform(*noise.rotation_deg)
    # the median length of a normal vector in space is 1.538 deviations of its parts
    scale = torch.tensor([np.deg2rad(median_deg)] * 3 + [median_m] * 3) / 1.538
    # a part of the error changes with the view, the other within a few frames
    moved = path.t_world_body.diff(dim=0).norm(dim=-1) / VIEW_M
    turned = rotation.geodesic(path.R_world_body[:-1], path.R_world_body[1:]) / np.deg2rad(VIEW_DEG)
    passed = path.timestamps.diff().float() / VIEW_S
    view = torch.cat([torch.zeros(1), (moved + turned + passed).cumsum(0)]).double().numpy()
    steps = int(8 * view[-1]) + 3
    coarse = smooth_noise(rng, steps, 6, 8.0, 1.0).numpy()
    slow = np.stack([np.interp(8 * view, np.arange(steps), column) for column in coarse.T], 1)
    quick = smooth_noise(rng, count, 6, 0.15, fps)
    lasting = np.sqrt(noise.lasting) * torch.from_numpy(slow).float()
    error = scale * (lasting + np.sqrt(1 - noise.lasting) * quick)
    wrong, off = _outliers(count, noise, rng, fps)
    error = torch.where(wrong[:, None], off, error).float()
    lost = _outages(count, fps, noise, rng, texture)
    # Confidence is like a share of inliers: high for small errors, low for most wrong frames, with much scatter.
    good = 0.92 - 0.09 * (error / scale.float()).norm(dim=-1).clamp(max=6.0).double().numpy() / np.sqrt(6 / 3)
    good += 0.10 * rng.standard_normal(count)
    bad = rng.beta(2.0, 7.0, count)
    fooled = rng.random(count) < noise.misjudged
    value = np.where(
        wrong.numpy() & ~fooled, bad, np.where(wrong.numpy(), 0.7 + 0.12 * rng.standard_normal(count), good)
    )
    confidence = torch.from_numpy(np.clip(value, 0.02, 1.0)).float()
    sure = confidence.clamp(min=0.02)[:, None]
    spread = scale.float() * (0.75 / sure) * torch.from_numpy(np.exp(0.3 * rng.standard_normal((count, 1))))
    R = rotation.exp(error[:, :3]) @ path.R_world_body
    found = Localization(
        path.timestamps, R, path.t_world_body + error[:, 3:], confidence, torch.diag_embed(spread.float() ** 2)
    )
    return _without(found, lost)


def with_outage(localization: Localization, start_s: float, length_s: float) -> Localization:
    """The same localisation without any found frames for a while from `start_s` (on its own clock).

    Raises WearcapError when no frame falls into it.
    """
    times = localization.timestamps
    lost = (times >= start_s) & (times < start_s + length_s)
    if not lost.any():
        expected = f"within {times[0]:.1f} to {times[-1]:.1f} s"
        raise WearcapError(f"an outage of {length_s} s at {start_s} s", expected=expected)
    return _without(localization, lost)


def _without(found: Localization, lost: Tensor) -> Localization:
    covariance = found.covariance
    if covariance is not None:
        covariance = torch.where(lost[:, None, None], torch.eye(6), covariance)
    return replace(
        found,
        R_world_cam=torch.where(lost[:, None, None], torch.eye(3), found.R_world_cam),
        t_world_cam=torch.where(lost[:, None], torch.zeros(3), found.t_world_cam),
        confidence=torch.where(lost, torch.zeros(()), found.confidence),
        covariance=covariance,
    )


def _outliers(count: int, noise: LocalizationNoise, rng: np.random.Generator, fps: float) -> tuple[Tensor, Tensor]:
    """Mask of wrong frames, in bursts, and their errors: rotation vector and position (time, 6)."""
    burst = smooth_noise(rng, count, 1, noise.burst_s, fps)[:, 0]
    wrong = burst > torch.quantile(burst[:: max(1, count // 100_000)], 1 - rng.uniform(*noise.outliers))
    number = torch.cat([wrong[:1], wrong[1:] & ~wrong[:-1]]).cumsum(0)
    bursts = int(number[-1]) + 1
    direction = rng.standard_normal((bursts, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = np.exp(rng.uniform(*np.log(noise.outlier_m), (bursts, 1)))
    turn = np.deg2rad(12.0) * length * rng.standard_normal((bursts, 3))
    jumpy = np.where(rng.random((bursts, 1)) < 0.5, 0.6, 0.08)  # Some stay at one wrong place, others leap about.
    offset = torch.from_numpy(np.concatenate([turn, length * direction], 1))[number]
    shake = torch.from_numpy(rng.standard_normal((count, 6)))
    return wrong, offset + shake * offset.abs().mean(-1, keepdim=True) * torch.from_numpy(jumpy)[number]


def _outages(
    count: int, fps: float, noise: LocalizationNoise, rng: np.random.Generator, texture: Tensor | None
) -> Tensor:
    """Mask of outages: intervals with log-uniform lengths, more likely at blank views."""
    lost = torch.zeros(count, dtype=torch.bool)
    left = rng.uniform(*noise.lost) * count
    pull = np.ones(count)
    if texture is not None:
        rank = texture.argsort().argsort().double().numpy() / max(count - 1, 1)
        pull = 1 + (BLANK_PULL - 1) * (1 - rank) ** 4
    while left > noise.outage_s[0] * fps:
        longest = min(noise.outage_s[1], left / fps)
        length = np.exp(rng.uniform(np.log(noise.outage_s[0]), np.log(max(longest, noise.outage_s[0] * 1.01))))
        start = int(rng.choice(count, p=pull / pull.sum()))
        stop = min(start + round(length * fps), count)
        lost[start:stop] = True
        left -= length * fps
    return lost
