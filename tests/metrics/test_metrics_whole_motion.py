"""All scores of a whole motion, and their spread over eight repetitions, against NumPy and SciPy alone."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.geometry import rotation
from wearcap.metrics.posture import PREFIX
from wearcap.metrics.table import Row, aggregate, evaluate_motion
from wearcap.recording import Motion

FPS, FRAMES = 20.0, 800
SIDES = ("left", "right")


def climbing(seed: int) -> Motion:
    """Someone who swings all joints and climbs 1.5 m in the middle: floors 10 s apart differ."""
    time = torch.arange(FRAMES, dtype=torch.float64) / FPS
    swing = 0.3 * torch.randn(23, 3, generator=torch.Generator().manual_seed(seed))
    rotvec = torch.sin(2.0 * time.float()[:, None, None] + torch.arange(23.0)[:, None]) * swing
    height = 0.9 + 1.5 * torch.sigmoid((time - 20).float()) + 0.05 * torch.cos(3 * time.float() + seed)
    root = torch.stack([0.7 * time.float(), 0.1 * torch.sin(time.float()), height], -1)
    return Motion(time, xsens23(), rotation.exp(rotvec), root)


def positions(motion: Motion) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Paths of all joints, and of heels and toe tips, bone by bone."""
    skeleton, R, t = motion.skeleton, {}, {}
    for joint, (name, parent) in enumerate(zip(skeleton.joint_names, skeleton.parents)):
        local = Rotation.from_matrix(motion.R_parent_joint[:, joint].double().numpy())
        if parent < 0:
            R[name], t[name] = local, motion.t_world_root.double().numpy()
            continue
        above = skeleton.joint_names[parent]
        R[name] = R[above] * local
        t[name] = t[above] + R[above].apply(skeleton.t_parent_joint[joint].double().numpy())
    sites = {
        patch: t[skeleton.sites[patch].joint] + R[skeleton.sites[patch].joint].apply(skeleton.sites[patch].t_joint_site)
        for patch in FOOT_PATCHES
    }
    return t, sites


def error(found: dict, true: dict, names) -> float:
    return 100 * np.mean([np.linalg.norm(found[name] - true[name], axis=1) for name in names])


def physicality(t: dict) -> float:
    acceleration = np.diff(t["pelvis"], 2, axis=0) * FPS**2
    acceleration[:, 2] = np.maximum(acceleration[:, 2], 0)
    size = np.linalg.norm(acceleration, axis=1)
    product = size / size.max()
    for side in SIDES:
        speeds = [np.linalg.norm(np.diff(t[f"{side}_{n}"], axis=0)[1:], axis=1) * FPS for n in ("ankle", "toe")]
        product = product * np.minimum(*speeds)
    return product.mean()


def skate(sites: dict, contact: np.ndarray) -> float:
    speeds = []
    for foot, side in enumerate(SIDES):
        heel, toe = sites[f"{side}_heel"], sites[f"{side}_toe_tip"]
        for frame in range(1, FRAMES):
            if contact[frame - 1 : frame + 1, foot].all():
                point = heel if heel[frame, 2] <= toe[frame, 2] else toe
                speeds.append(100 * FPS * math.dist(point[frame, :2], point[frame - 1, :2]))
    return np.mean(speeds)


def test_every_score_of_a_motion_is_what_numpy_makes_of_it():
    true, found = climbing(0), climbing(1)
    touching = torch.rand(FRAMES, 4, generator=torch.Generator().manual_seed(2)) < 0.6
    scores = evaluate_motion(found, true, touching)
    (t, sites), (t_true, sites_true) = positions(found), positions(true)
    names = list(xsens23().joint_names)
    lower = [f"{side}_{name}" for side in SIDES for name in ("hip", "knee", "ankle", "toe")]
    upper = [name for name in names if name not in (*lower, "pelvis")]
    hands = ["left_wrist", "right_wrist"]
    parts = {
        "head": ["neck", "head"],
        "trunk": ["pelvis", "l5", "l3", "t12", "t8", "left_collar", "right_collar"],
        "arm": [f"{side}_{name}" for side in SIDES for name in ("shoulder", "elbow")],
        "leg": [f"{side}_{name}" for side in SIDES for name in ("hip", "knee")],
        "foot": [f"{side}_{name}" for side in SIDES for name in ("ankle", "toe")],
    }
    assert sorted([*hands, *(name for part in parts.values() for name in part)]) == sorted(names)
    errors = {
        key: 100 * np.mean([np.linalg.norm(t[n] - t_true[n], axis=1) for n in part], axis=0)
        for key, part in {"cm": names, "hand_pe_cm": hands, "lower_pe_cm": lower, "upper_pe_cm": upper}.items()
    }
    lowest = np.min([t[n][:, 2] for n in names], axis=0)
    lowest_true = np.min([t_true[n][:, 2] for n in names], axis=0)
    reach = int(10 * FPS)
    floor = np.array([lowest_true[max(0, f - reach) : f + reach + 1].min() for f in range(FRAMES)])
    assert np.ptp(floor) > 1
    third = np.mean([np.linalg.norm(np.diff(t[n], 3, axis=0), axis=1) for n in names]) * FPS**3
    third_true = np.mean([np.linalg.norm(np.diff(t_true[n], 3, axis=0), axis=1) for n in names]) * FPS**3
    turn = Rotation.from_matrix(found.R_parent_joint.double().numpy().reshape(-1, 3, 3)).inv()
    turn = turn * Rotation.from_matrix(true.R_parent_joint.double().numpy().reshape(-1, 3, 3))
    expected = {
        "mpjpe_cm": error(t, t_true, names),
        "hand_pe_cm": error(t, t_true, ("left_wrist", "right_wrist")),
        "lower_pe_cm": error(t, t_true, lower),
        "upper_pe_cm": error(t, t_true, upper),
        **{f"{part}_pe_cm": error(t, t_true, joints) for part, joints in parts.items()},
        **{f"p95_{key}": np.percentile(value, 95) for key, value in errors.items()},
        "p95_floor_penetration_cm": 100 * np.percentile(np.maximum(floor - lowest, 0), 95),
        "root_cm": error(t, t_true, ["pelvis"]),
        "mpjve_cm_s": 100 * FPS * np.mean([np.linalg.norm(np.diff(t[n] - t_true[n], axis=0), axis=1) for n in names]),
        "rotation_deg": np.degrees(turn.magnitude()).mean(),
        "jitter_m_s3": third,
        "jitter_ratio": third / third_true,
        "foot_skate_cm_s": skate(sites, touching.numpy().reshape(FRAMES, 2, 2).any(-1)),
        "physicality": physicality(t),
        "truth_physicality": physicality(t_true),
        "floor_penetration_cm": 100 * np.maximum(floor - lowest, 0).mean(),
        "truth_jitter_m_s3": third_true,
        "truth_foot_skate_cm_s": skate(sites_true, touching.numpy().reshape(FRAMES, 2, 2).any(-1)),
        "truth_floor_penetration_cm": 0.0,
    }
    assert scores["floor_penetration_cm"] > 0.01
    assert {name for name in scores if not name.startswith(PREFIX)} == set(expected)
    for name, value in expected.items():
        assert scores[name] == pytest.approx(value, rel=1e-4), name


def test_eight_repetitions_have_mean_and_sample_spread():
    random = np.random.default_rng(0)
    frames, p95, mpjpe = (np.array([100, 250, 50]), random.uniform(5, 30, (8, 3)), random.uniform(5, 30, (8, 3)))
    rows = [
        Row(f"r{r}", seed, int(frames[r]), {"p95_cm": p95[seed, r], "mpjpe_cm": mpjpe[seed, r]})
        for seed in range(8)
        for r in range(3)
    ]
    means = aggregate(rows)
    by_frames = mpjpe @ frames / frames.sum()
    assert means["mpjpe_cm"].mean == pytest.approx(by_frames.mean())
    assert means["mpjpe_cm"].std == pytest.approx(by_frames.std(ddof=1))
    assert means["p95_cm"].mean == pytest.approx(p95.mean())  # of every sequence, each counting alike
    assert means["p95_cm"].std == pytest.approx(p95.mean(1).std(ddof=1))
    assert means["p95_cm"].seeds == 8
