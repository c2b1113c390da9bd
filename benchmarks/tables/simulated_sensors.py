"""Errors of the simulated sensors, measured against the truth that they were drawn from.

Every function draws one sensor and returns what is off by name with unit. `SQUARED` of them are signed or have no
direction: their root mean square over draws is the figure, of all others the mean.
"""

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from benchmarks.tables.hps_sessions import TrueClock
from benchmarks.tables.tabling import summarize
from benchmarks.tables.wearables import WEARABLES
from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion, RecordingStore
from wearcap.recording.recording import Intervals
from wearcap.sensors.claps import detect_claps
from wearcap.sensors.clock import mutual_pairs
from wearcap.sensors.imu import GRAVITY, ImuNoise, synthesize_imu
from wearcap.sensors.simulated import SlamNoise, head_stream
from wearsim.recordings.hps import HpsConfig, Simulated, simulate_hps
from wearsim.recordings.interaction_session import flat_of
from wearsim.recordings.localization_noise import LocalizationNoise, by_gravity, localize_statistically
from wearsim.recordings.measured import EnvironmentErrors, as_measured
from wearsim.rendering.head_camera import HEAD_CAMERA_TRUTH, head_camera
from wearsim.sensors.suit import SUITS, SuitNoise, suit_motion

Values = dict[str, float]
OUTLIER_M = 0.3
"""Localised positions that are further off are outliers."""
CLAP_S = 0.05
"""A clap is heard within."""
STILL_S = 600.0
"""How long a watch lies still."""
REACH_S, SLOW = 2.0, 0.05
"""Time before a contact in which its reach is, and the share of the peak speed that begins and ends it."""
SQUARED = (
    "heading_deg_per_sqrt_min",
    "length_percent",
    "bone_percent",
    "stature_cm",
    "height_cm",
    "bend_cm",
    "bias_mg",
    "attitude_deg",
    "heading_after_10_min_deg",
    "strap_deg",
    "jitter_mm",
    "jitter_deg",
    "head_cm",
    "head_deg",
    "drift_percent",
    "placement_cm",
    "placement_deg",
    "hinge_cm",
)


WATCHES = {name: noise.watches for name, noise in WEARABLES.items()}
"""Watches by name."""
HEADS = {name: noise.head for name, noise in WEARABLES.items()}
"""Head trackers by name."""


@dataclass(frozen=True)
class Sensing:
    """What is drawn: sessions, draws of each sensor in each, and the data set whose hands are looked at."""

    config: HpsConfig
    sessions: int
    draws: int
    interactions: Path


def reduced(draws: Iterable[Values]) -> dict[str, dict[str, Any]]:
    """Over draws: means with their deviation, and root mean squares; what is NaN is left out."""
    columns: dict[str, list[float]] = defaultdict(list)
    for draw in draws:
        for name, value in draw.items():
            columns[name] += [value] if math.isfinite(value) else []
    found = {}
    for name, values in columns.items():
        if name in SQUARED and values:
            found[name] = {
                "mean": math.sqrt(sum(v * v for v in values) / len(values)),
                "std": None,
                "seeds": len(values),
            }
        else:
            found[name] = summarize(values)
    return found


def sensors(options: Sensing) -> dict[str, dict[str, dict[str, Any]]]:
    """All statistics by preset of the sensor ("typical" where a sensor has one alone) and quantity."""
    draws: dict[str, list[Values]] = defaultdict(list)
    for seed in range(options.sessions):
        made = session(seed, options.config)
        motion = made.motion.motion
        for draw in range(options.draws):
            rng = np.random.default_rng([34, seed, draw])
            for name in SUITS:
                draws[name].append(suit_errors(made, SuitNoise.preset(name), options.config.protocol.returns_m, rng))
                draws[name].append(localization_errors(made, LocalizationNoise.preset(name), rng))
            for name, noise in WATCHES.items():
                draws[name].append(watch_errors(motion, noise, rng))
            for name, noise in HEADS.items():
                draws[name].append(head_errors(motion, noise, rng))
            draws["typical"].append(clock_errors(motion, options.config, rng))
        draws["typical"].append(clap_errors(made, seed))
        draws["typical"] += environment_errors(seed, EnvironmentErrors(), np.random.default_rng([35, seed]))
    if (options.interactions / "manifest.json").is_file():
        store = RecordingStore.open(options.interactions)
        draws["typical"] += [hand_statistics(store, name) for name in store.names("test")]
    return {name: reduced(found) for name, found in draws.items()}


def session(seed: int, config: HpsConfig) -> Simulated:
    """A walk of the test split, without localisation."""
    return simulate_hps(replace(config, localization=None), f"sensors-{seed}", "test", seed)


def suit_errors(
    simulated: Simulated, noise: SuitNoise, returns_m: tuple[float, ...], rng: np.random.Generator
) -> Values:
    motion, contact = simulated.motion.motion, simulated.motion.contact
    suit = suit_motion(motion, contact, noise, rng)
    minutes = simulated.recording.duration_s / 60
    off = suit.T_world_joint.R @ motion.T_world_joint.R.mT
    heading = torch.atan2((off[..., 1, 0] - off[..., 0, 1]).sum(1), (off[..., 0, 0] + off[..., 1, 1]).sum(1))
    turned = np.unwrap(heading.double().numpy())
    upright = rotation.about_axis("z", -heading)[:, None] @ off
    walked = [root[:, :2].diff(dim=0).norm(dim=1).sum().item() for root in (suit.t_world_root, motion.t_world_root)]
    bones = [skeleton.t_parent_joint[1:].norm(dim=-1) for skeleton in (suit.skeleton, motion.skeleton)]
    long = bones[1] > 0.02
    inner = rotation.geodesic(suit.R_parent_joint[:, 1:], motion.R_parent_joint[:, 1:])
    height = 100 * (suit.t_world_root - motion.t_world_root)[:, 2]
    late, wrong = flag_errors(suit.contact_prob, contact, motion.fps)
    assert simulated.recording.intervals is not None
    return {
        "heading_deg_per_sqrt_min": math.degrees(turned[-1] - turned[0]) / math.sqrt(minutes),
        "length_percent": 100 * (walked[0] / walked[1] - 1),
        "bone_percent": 100 * (bones[0][long] / bones[1][long] - 1).square().mean().sqrt().item(),
        "stature_cm": 100 * (suit.skeleton.stature - motion.skeleton.stature),
        "segment_deg": math.degrees(rotation.geodesic(upright, torch.eye(3).expand_as(upright)).mean().item()),
        "joint_deg": math.degrees(inner.square().mean().sqrt().item()),
        "height_cm": height.mean().item(),
        "height_drift_cm": height.std().item(),
        "contact_late_ms": 1000 * late,
        "contact_wrong_percent": 100 * wrong,
        **_off_at_visits(suit, motion, simulated.recording.intervals, returns_m),
    }


def _off_at_visits(suit: Motion, motion: Motion, visits: Intervals, returns_m: tuple[float, ...]) -> Values:
    """Horizontal error of the root (cm) at the stands after the start, by the distance of the protocol."""
    error = 100 * (suit.t_world_root - motion.t_world_root)[:, :2].norm(dim=1)
    starts = [start for name, start in zip(visits.names, visits.start_s.tolist()) if name == "stand"][1:]
    return {f"off_after_{m:.0f}_m_cm": error[int(start * motion.fps)].item() for m, start in zip(returns_m, starts)}


def flag_errors(prob: Tensor | None, contact: Bool[Tensor, "time patch"], fps: float) -> tuple[float, float]:
    """Delay (s) at which reported flags agree best with the true ones, and the share that is wrong then."""
    assert prob is not None
    flags = prob > 0.5
    wrong = [(flags[lag:] != contact[: len(contact) - lag]).float().mean().item() for lag in range(round(0.1 * fps))]
    lag = int(np.argmin(wrong))
    return lag / fps, wrong[lag]


def localization_errors(simulated: Simulated, noise: LocalizationNoise, rng: np.random.Generator) -> Values:
    path = simulated.recording.object_motion[HEAD_CAMERA_TRUTH]
    found = localize_statistically(path, noise, rng)
    seen = found.confidence > 0
    error = (found.t_world_cam - path.t_world_body).norm(dim=-1)[seen]
    turned = torch.rad2deg(rotation.geodesic(found.R_world_cam, path.R_world_body))[seen]
    good = error <= OUTLIER_M
    still = replace(noise, position_m=(0.0, 0.0), rotation_deg=(0.0, 0.0), outliers=(0.0, 0.0), lost=(0.0, 0.0))
    bent = localize_statistically(path, still, rng)
    bend = (bent.t_world_cam - path.t_world_body)[bent.confidence > 0]
    motion = simulated.motion.motion
    leaning = by_gravity(motion, noise.map, rng)
    tilt = rotation.geodesic(leaning.R_parent_joint[:1, 0], motion.R_parent_joint[:1, 0])
    edges = torch.cat([torch.tensor([False]), ~seen, torch.tensor([False])]).int().diff().nonzero()[:, 0]
    lengths = (edges[1::2] - edges[::2]) * path.timestamps.diff().median().item()
    return {
        "position_cm": 100 * error[good].median().item(),
        "rotation_deg": turned[good].median().item(),
        "outlier_percent": 100 * (1 - good.float().mean().item()),
        "lost_percent": 100 * (1 - seen.float().mean().item()),
        "longest_outage_s": lengths.max().item() if len(lengths) else 0.0,
        "tilt_deg": math.degrees(tilt.item()),
        "scale_percent": 100 * abs(leaning.skeleton.stature / motion.skeleton.stature - 1),
        "bend_cm": 100 * bend.square().mean().sqrt().item(),
    }


def watch_errors(motion: Motion, noise: ImuNoise, rng: np.random.Generator) -> Values:
    """A watch that lies still for ten minutes, worn without play for what is the sensor's, then with it."""
    count = round(STILL_S * motion.fps)
    still = replace(
        motion,
        timestamps=torch.arange(count, dtype=torch.float64) / motion.fps,
        R_parent_joint=motion.R_parent_joint[:1].expand(count, -1, -1, -1),
        t_world_root=motion.t_world_root[:1].expand(count, -1),
        contact_prob=None,
    )
    tight = synthesize_imu(still, "left_wrist", noise=replace(noise, strap_deg=0.0), rng=rng)
    worn = synthesize_imu(still, "left_wrist", noise=noise, rng=rng)
    R_true = still.joint("left_wrist").R
    assert tight.acc_imu is not None
    assert tight.gyro_imu is not None
    assert tight.R_world_imu is not None
    assert worn.acc_imu is not None
    bandwidth = math.sqrt(motion.fps / 2)
    up = torch.tensor([0.0, 0.0, 1.0])
    lean = rotation_angle_of(tight.R_world_imu.mT @ up, R_true.mT @ up)
    turned = tight.R_world_imu @ R_true.mT
    yaw = torch.rad2deg(torch.atan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1]))
    resting = R_true[0].mT @ (GRAVITY * up)
    return {
        "noise_ug_per_sqrt_hz": 1e6 * tight.acc_imu.std(0).mean().item() / GRAVITY / bandwidth,
        "gyro_deg_s_per_sqrt_hz": math.degrees(tight.gyro_imu.std(0).mean().item()) / bandwidth,
        "bias_mg": 1e3 * (tight.acc_imu.mean(0) - resting).square().mean().sqrt().item() / GRAVITY,
        "attitude_deg": lean.square().mean().sqrt().item(),
        "heading_after_10_min_deg": (yaw[-60:].mean() - yaw[:60].mean()).item(),
        "strap_deg": rotation_angle_of(worn.acc_imu.mean(0)[None], resting[None]).item(),
    }


def rotation_angle_of(a: Tensor, b: Tensor) -> Tensor:
    """Angles (°) between vectors."""
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1)))


def head_errors(motion: Motion, noise: SlamNoise, rng: np.random.Generator) -> Values:
    stream = head_stream(motion, torch.zeros(3), noise, rng)
    true = motion.joint("head")
    off = (stream.t_world_device - true.t).double()
    path_m = true.t.diff(dim=0).norm(dim=-1).sum().item()
    second = round(motion.fps)
    quick = (
        off
        - off.unfold(0, 2 * second + 1, 1).mean(-1)[[0] * second + list(range(len(off) - 2 * second)) + [-1] * second]
    )
    angle = torch.rad2deg(rotation.geodesic(stream.R_world_device, true.R))
    return {
        "jitter_mm": 1e3 * quick.square().mean().sqrt().item(),
        "jitter_deg": (angle.square().mean() / 3).sqrt().item(),
        "head_cm": 100 * off.square().sum(-1).mean().sqrt().item(),
        "head_deg": angle.square().mean().sqrt().item(),
        "drift_percent": 100 * (off[-second:].mean(0) - off[:second].mean(0)).norm().item() / path_m,
    }


def clock_errors(motion: Motion, config: HpsConfig, rng: np.random.Generator) -> Values:
    _, _, (offset, drift) = head_camera(motion, torch.zeros(3), config, rng)
    return {"clock_drift_ms_per_h": drift, "clock_offset_s": abs(offset)}


def clap_errors(simulated: Simulated, seed: int) -> Values:
    """The claps that are heard in the sound track and felt by both wrists."""
    recording, truth = simulated.recording, TrueClock.of(simulated.recording)
    assert recording.camera is not None
    first = recording.camera.timestamps[0]
    true = truth.to_camera(truth.claps_s) - first
    try:
        heard = torch.tensor(truth.heard_s(recording, seed), dtype=torch.float64)
        felt = detect_claps(*(recording.imu[joint] for joint in WRISTS))
    except WearcapError:
        return {"claps_heard_percent": 0.0, "claps_felt_percent": 0.0}
    minutes = recording.duration_s / 60
    return {**_clap_scores("heard", heard, true, minutes), **_clap_scores("felt", felt, truth.claps_s, minutes)}


def _clap_scores(how: str, found: Float64[Tensor, "clap"], true: Float64[Tensor, "clap"], minutes: float) -> Values:
    mine, theirs = mutual_pairs(found.numpy(), true.numpy(), CLAP_S)
    off = np.abs(found.numpy()[mine] - true.numpy()[theirs])
    return {
        f"claps_{how}_percent": 100 * len(mine) / len(true),
        f"claps_{how}_false_per_min": (len(found) - len(mine)) / minutes,
        f"claps_{how}_off_ms": 1e3 * float(off.mean()) if len(off) else math.nan,
    }


def environment_errors(number: int, errors: EnvironmentErrors, rng: np.random.Generator) -> list[Values]:
    """Of every object of a flat."""
    true = flat_of("test", number).environment
    found = []
    for item, measured in zip(true.objects, as_measured(true, errors, rng).objects):
        turned = rotation.geodesic(measured.R_world_object[None].double(), item.R_world_object[None].double())
        middle = [torch.from_numpy(each.box_world.mean(0)) for each in (item, measured)]
        values = {
            "placement_cm": 100 * (middle[1] - middle[0])[:2].norm().item(),
            "placement_deg": math.degrees(turned.item()),
        }
        if item.freedom.pivot is not None and measured.freedom.pivot is not None:
            off = torch.tensor(measured.freedom.pivot) - torch.tensor(item.freedom.pivot)
            values["hinge_cm"] = 100 * off[:2].norm().item()
        found.append(values)
    return found


def hand_statistics(store: RecordingStore, name: str) -> Values:
    """How often, how long and with which hands somebody holds something, and how hands get there."""
    recording = store.load(name)
    motion, held = recording.motion, recording.interactions
    assert motion is not None
    assert held is not None
    minutes = recording.duration_s / 60
    length = (held.stop_s - held.start_s).numpy()
    reaches = [
        reach
        for start, hands in zip(held.start_s.tolist(), held.hands.tolist())
        for joint, holds in zip(("left_wrist", "right_wrist"), hands)
        if holds and (reach := _reach(motion, joint, start)) is not None
    ]
    touching = held.hand_contact(motion.timestamps).float().mean(0)
    return {
        "holds_per_min": len(held) / minutes,
        "hold_s": float(np.median(length)) if len(length) else math.nan,
        "held_percent": 100 * touching.mean().item(),
        "both_hands_percent": 100 * held.hands.all(1).float().mean().item() if len(held) else math.nan,
        "reach_s": float(np.median([seconds for seconds, _ in reaches])) if reaches else math.nan,
        "reach_peak_over_mean": float(np.median([peak for _, peak in reaches])) if reaches else math.nan,
    }


def _reach(motion: Motion, joint: str, contact_s: float) -> tuple[float, float] | None:
    """Duration (s) of the hand's last movement before a contact, against the chest, and its peak over its mean speed."""
    stop = int((contact_s - float(motion.timestamps[0])) * motion.fps)
    start = stop - round(REACH_S * motion.fps)
    if start < 0:
        return None
    T_chest_world = motion.joint("t8")[start:stop].inverse()
    hand: Tensor = T_chest_world @ motion.joint(joint).t[start:stop]  # pyright: ignore[reportAssignmentType]
    return movement((hand.diff(dim=0).norm(dim=-1) * motion.fps).numpy(), motion.fps)


def movement(speed: Float[np.ndarray, "time"], fps: float) -> tuple[float, float] | None:
    """Duration (s) of the fastest movement, and its peak over its mean speed; None where it has no beginning.

    It begins and ends at `SLOW` of its peak: a movement of minimum jerk is cut to 0.88 of its duration, and has a ratio of
    1.66 instead of 1.88.
    """
    peak = int(speed.argmax())
    quiet = np.flatnonzero(speed < SLOW * speed[peak])
    before, after = quiet[quiet < peak], quiet[quiet > peak]
    moving = speed[before[-1] + 1 if len(before) else 0 : after[0] if len(after) else len(speed)]
    return (len(moving) / fps, float(moving.max() / moving.mean())) if len(before) else None
