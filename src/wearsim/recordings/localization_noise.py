"""Camera poses as localisation in a map would find them, drawn from a statistical model without images.

Good frames are off by some centimetres, mostly depending on the view, so that the error persists while the view
does; bursts of frames are plainly wrong; and for seconds nothing is found at all, mostly in front of blank walls.
Confidence and covariance follow from the number of matches, as a localiser counts them: they tell how large errors are
to be expected, not how large one is. The map itself is tilted and bent.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.stats
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.errors import require_choice
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Localization
from wearcap.sensors.simulated import smooth_noise

VIEW_M, VIEW_DEG, VIEW_S = 0.8, 35.0, 12.0
"""Translation, rotation and time that change a view, and with it the lasting part of the error."""
BLANK_PULL = 3.0
"""Ratio of the outage rates at the blankest views and at rich ones."""


@dataclass(frozen=True)
class MapErrors:
    """What a map and its scan do to everybody; values are drawn uniformly from the ranges once per recording."""

    tilt_deg: tuple[float, float] = (0.3, 1.5)
    """Angle between the map's vertical axis and gravity."""
    scale: tuple[float, float] = (0.002, 0.005)
    """Share by which the map's metre is too long or too short."""
    bend_m: tuple[float, float] = (0.005, 0.015)
    """Deviation, along each axis, of localised positions from the scan's, which varies over `bend_over_m`."""
    bend_over_m: float = 50.0


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
    map: MapErrors = field(default_factory=MapErrors)

    @classmethod
    def preset(cls, name: str) -> "LocalizationNoise":
        """Localisation "ideal", "typical" or "poor". Raises WearcapError for another name."""
        require_choice(name, LOCALIZATIONS, f"localization={name!r}")
        return LOCALIZATIONS[name]


LOCALIZATIONS = {
    "ideal": LocalizationNoise(
        (0.01, 0.03), (0.3, 0.8), outliers=(0.0, 0.02), lost=(0.0, 0.02), outage_s=(1.0, 10.0), misjudged=0.05,
        map=MapErrors((0.0, 0.1), (0.0, 0.0005), (0.0, 0.002)),
    ),
    "typical": LocalizationNoise(),
    "poor": LocalizationNoise(
        (0.06, 0.12), (1.5, 3.0), outliers=(0.12, 0.25), lost=(0.06, 0.15), misjudged=0.3,
        map=MapErrors((1.0, 2.0), (0.004, 0.008), (0.01, 0.03)),
    ),
}  # fmt: skip
"""Localisations by name."""
EXPECTED_ERROR = 0.35
"""Change of the logarithm of the expected error by one deviation of the quality of a view."""


def by_gravity(suit: Motion, errors: MapErrors, rng: np.random.Generator) -> Motion:
    """A suit's motion as it is measured, upright by gravity and in metres, where it was given in a map's axes.

    Seen from a map that is tilted and whose metre is too long, gravity leans and the body is small.
    """
    direction = rng.uniform(0.0, 2 * np.pi)
    lean = np.deg2rad(rng.uniform(*errors.tilt_deg)) * torch.tensor([np.cos(direction), np.sin(direction), 0.0])
    R_world_map = rotation.exp(lean.float())
    scale = 1 + float(rng.uniform(*errors.scale)) * float(rng.choice([-1, 1]))
    start = suit.t_world_root[0]
    R_parent_joint = suit.R_parent_joint.clone()
    R_parent_joint[:, 0] = R_world_map @ R_parent_joint[:, 0]
    return replace(
        suit,
        skeleton=suit.skeleton.scaled(scale),
        R_parent_joint=R_parent_joint,
        t_world_root=start + scale * (suit.t_world_root - start) @ R_world_map.mT,
    )


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
    coarse = smooth_noise(rng, steps, 7, 8.0, 1.0).numpy()
    slow = np.stack([np.interp(8 * view, np.arange(steps), column) for column in coarse.T], 1)
    quick = smooth_noise(rng, count, 6, 0.15, fps)
    # A view has more matches or fewer; with fewer, larger errors are to be expected.
    quality = slow[:, 6]
    if texture is not None:
        rank = texture.argsort().argsort().double().numpy()
        quality = (quality + scipy.stats.norm.ppf((rank + 0.5) / count)) / np.sqrt(2)
    expected = scale * torch.from_numpy(np.exp(-EXPECTED_ERROR * quality))[:, None]
    lasting = np.sqrt(noise.lasting) * torch.from_numpy(slow[:, :6]).float()
    error = expected * (lasting + np.sqrt(1 - noise.lasting) * quick)
    wrong, off = _outliers(count, noise, rng, fps)
    error = torch.where(wrong[:, None], off, error).float()
    error[:, 3:] += _bend(path, noise.map, rng)
    lost = _outages(count, fps, noise, rng, texture)
    # Confidence is like a share of inliers: that of the view, low for most wrong frames, with much scatter.
    good = 0.75 + 0.10 * quality + 0.08 * rng.standard_normal(count)
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
    return without(found, lost)


def without(found: Localization, lost: Bool[Tensor, "time"]) -> Localization:
    """A localisation whose lost frames have not been found."""
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


def _bend(path: Trajectory, errors: MapErrors, rng: np.random.Generator) -> Float[Tensor, "time 3"]:
    """Displacement of localised positions (m) by a map that is bent against the scan: smooth over the floor."""
    wave = rng.standard_normal((32, 2)) * 2 * np.pi / errors.bend_over_m
    phase = rng.uniform(0.0, 2 * np.pi, (3, 32))
    along = path.t_world_body[:, :2].double().numpy() @ wave.T
    bend = np.sqrt(2 / 32) * np.cos(along[:, None] + phase).sum(-1)
    return torch.from_numpy(rng.uniform(*errors.bend_m) * bend).float()


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
