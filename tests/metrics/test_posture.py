"""Postures of made bodies, and errors by them."""

import pytest
import torch

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.evaluation.breakdown import by_posture
from wearcap.geometry import rotation
from wearcap.metrics.posture import POSTURES, errors_by_posture, postures
from wearcap.metrics.table import Row

FPS, FRAMES = 30.0, 30
BOTH = ("left", "right")


def legs(hip: float, knee: float, ankle: float = 0.0) -> dict[str, float]:
    """Rotations (degrees) about the left axis: hips forward, knees back, ankles up."""
    return {
        f"{side}_{name}": angle for side in BOTH for name, angle in (("hip", -hip), ("knee", knee), ("ankle", -ankle))
    }


MADE = {
    "standing": ({}, 0.0),
    "walking": (legs(10, 15), 1.2),
    "sitting": (legs(85, 85), 0.0),
    "squatting": ({"pelvis": 30.0, **legs(140, 140, 30)}, 0.0),
    "lying": ({"pelvis": -90.0}, 0.0),
    "bending": ({"pelvis": 70.0, **legs(70, 0)}, 0.0),
}
CRAWLING = {"pelvis": 80.0, **legs(80, 90, -80)}
KNEELING = legs(5, 95)


def of_pose(angles: dict[str, float], speed_m_s: float = 0.0, floor_m: float = 0.0):
    """Postures of a pose that is kept, its lowest joint 6 cm above the floor, while it moves ahead."""
    body = xsens23()
    R = torch.eye(3).repeat(FRAMES, len(body), 1, 1)
    for name, angle in angles.items():
        R[:, body.index(name)] = rotation.about_axis("y", torch.tensor(angle).deg2rad())
    root = torch.zeros(FRAMES, 3)
    root[:, 0] = speed_m_s * torch.arange(FRAMES) / FPS
    low = forward_kinematics(body, R, root).t[..., 2].min()
    root[:, 2] = floor_m + 0.06 - low
    return postures(body, forward_kinematics(body, R, root), torch.full((FRAMES,), floor_m), FPS)


@pytest.mark.parametrize("floor_m", [0.0, -1.3])
@pytest.mark.parametrize(("name", "angles", "speed_m_s"), [(name, *pose) for name, pose in MADE.items()])
def test_made_poses_are_what_they_are(name, angles, speed_m_s, floor_m):
    found = of_pose(angles, speed_m_s, floor_m)
    assert found.pop("head_down").all() == (name == "bending")
    assert {each for each, frames in found.items() if frames.all()} == {name}
    assert sum(frames.sum() for frames in found.values()) == FRAMES


def test_kin_of_postures():
    """Crawling counts as lying, kneeling as squatting; a bowed head is one beside what the body does."""
    assert of_pose(CRAWLING)["lying"].all()
    assert of_pose(KNEELING)["squatting"].all()
    for angle, down in ((35.0, False), (45.0, True)):
        found = of_pose({"head": angle})
        assert found["standing"].all()
        assert bool(found["head_down"].all()) == down


def test_errors_are_means_over_the_frames_of_a_posture():
    """Two recordings of different length against the same frames in one, by hand."""
    body, random = xsens23(), torch.Generator().manual_seed(0)
    rows, every, still = [], [], []
    for name, count in (("a", 40), ("b", 120)):
        error, standing = torch.rand(count, len(body), generator=random), torch.rand(count, generator=random) < 0.3
        of_truth = {
            posture: standing if posture == "standing" else ~standing & (posture == "other") for posture in POSTURES
        }
        scores = {"mpjpe_cm": 1.0, **errors_by_posture(body, of_truth, error, "cm")}
        rows.append(Row(name, 0, count, scores))
        every.append(error)
        still.append(standing)
    error, standing = torch.cat(every), torch.cat(still)
    found, shares = by_posture(rows)
    assert set(found) == {"standing", "other"}
    assert found["standing"]["mpjpe_cm"].mean == pytest.approx(error[standing].mean().item())
    hands = [body.index(f"{side}_wrist") for side in BOTH]
    assert found["other"]["hand_pe_cm"].mean == pytest.approx(error[~standing][:, hands].mean().item())
    assert shares["standing"] == pytest.approx(standing.float().mean().item())
    millimetres = errors_by_posture(body, {"standing": torch.ones(40, dtype=torch.bool)}, every[0], "mm")
    assert millimetres["posture_standing_mpjpe_mm"] == pytest.approx(10 * every[0].mean().item())
