"""A SLAM's similarity from four positions of the camera, its scale from walks, the camera's mount from standing."""

import math

import numpy as np
import pytest
import torch
from planted_session import SEEDS, apart_deg, session

import calibration_session as simulated
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.sensors.camera_alignment import HeadMount, align_by_marks, mark_positions, mount_by_standing
from wearcap.sensors.monocular_slam import scale_by_walks
from wearcap.sensors.stillness import require

MARKS, STANDING = simulated.MARKS, simulated.STANDING
WORLD = torch.tensor([[0, 0.1, 0.8], [0, 0.6, 0.8], [0.15, 0, 0.8], [0.55, 0, 0.8]], dtype=torch.float64)
DISTANCES = (0.5, 0.4)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_planted_session_is_recovered(seed):
    made = session(seed)
    marks, moved, turned = mark_positions(made.slam, MARKS)
    found = align_by_marks(marks, made.measured.distances_m, made.measured.mark_height_m)
    assert found.scale == pytest.approx(made.planted.scale, rel=0.005)
    assert apart_deg(found.R_world_slam, made.planted.R_world_slam) < 0.5
    true = made.planted.scale * marks @ made.planted.R_world_slam.mT + made.planted.t_world_slam
    assert (found.points(marks) - true).norm(dim=-1).max() < 0.005
    aligned = found.apply(made.slam)
    mount = mount_by_standing(aligned, STANDING)
    assert apart_deg(mount.R_head_cam, made.planted.R_head_cam) < 0.5
    require([*found.checks(found.scale * moved, turned), *mount.checks()])
    head = mount.apply(aligned)
    upright = (head.timestamps > STANDING[0]) & (head.timestamps < STANDING[1])
    yaw = rotation.yaw_of(rotation.mean_rotation(head.R_world_device[upright]))
    assert math.degrees(yaw) == pytest.approx(90, abs=0.01)


def similar(seed: int = 0) -> tuple[torch.Tensor, float, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    R, t = rotation.exp(torch.from_numpy(rng.normal(0, 1, 3))), torch.from_numpy(rng.normal(0, 3, 3))
    scale = float(rng.uniform(0.1, 9))
    return (WORLD - t) @ R / scale, scale, R, t


@pytest.mark.parametrize("seed", range(10))
def test_exact_positions_give_the_exact_similarity(seed):
    marks, scale, R, t = similar(seed)
    found = align_by_marks(marks, DISTANCES, 0.8)
    assert found.scale == pytest.approx(scale, rel=1e-7)
    torch.testing.assert_close(found.R_world_slam, R, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.t_world_slam, t, atol=1e-6, rtol=0)
    assert found.residual_m < 1e-7
    assert found.corner_deg < 1e-4


def test_what_is_measured_wrongly_shows_in_the_checks():
    marks, scale, *_ = similar()
    still = (torch.zeros(4, dtype=torch.float64), [0.0] * 4)
    spread = align_by_marks(marks, (0.5, 0.44), 0.8)
    assert spread.scale_spread == pytest.approx(0.095, abs=0.002)
    with pytest.raises(WearcapError, match=r"scales by the two distances differ: 9.5. %. Expected at most 3 %"):
        require(spread.checks(*still))
    askew = marks.clone()
    askew[3] += (marks[1] - marks[0]) * 0.1
    with pytest.raises(WearcapError, match="axes miss a right angle: 7"):
        require(align_by_marks(askew, DISTANCES, 0.8).checks(*still))
    with pytest.raises(WearcapError, match="camera on C2: moves: 0.02 m.*Let go of the camera"):
        require(align_by_marks(marks, DISTANCES).checks(torch.tensor([0.0, 0.02, 0, 0]), [0.0] * 4))
    lifted = marks.clone()
    lifted[0] += torch.linalg.cross(marks[1] - marks[0], marks[3] - marks[2]) * scale * 0.5  # by 10 cm
    with pytest.raises(WearcapError, match="camera on the board: residual: 0.0[0-9]+ m. Expected at most 0.01"):
        require(align_by_marks(lifted, DISTANCES, 0.8).checks(*still)[-1:])


@pytest.mark.parametrize(
    ("change", "distances", "match"),
    [
        (lambda C: C[[0, 0, 2, 3]], DISTANCES, "four different places"),
        (lambda C: C, (0.5, 0.0), "distances above 0"),
        (lambda C: C[[0, 1, 0, 1]], DISTANCES, "0° apart.*Expected 90°"),
        (lambda C: C * torch.nan, DISTANCES, "four different places"),
    ],
)
def test_positions_that_say_nothing_are_refused(change, distances, match):
    with pytest.raises(WearcapError, match=match):
        align_by_marks(change(similar()[0]), distances)


def test_four_stretches_are_needed():
    made = session(0)
    with pytest.raises(WearcapError, match="3 stretches.*four"):
        mark_positions(made.slam, MARKS[:3])
    with pytest.raises(WearcapError, match="camera on C2.*at least 1 s"):
        mark_positions(made.slam, [MARKS[0], (30.0, 30.5), *MARKS[2:]])


def straight_walk() -> Trajectory:
    times = torch.arange(0, 20, 0.1, dtype=torch.float64)
    along = torch.stack([0.5 * times.clamp(max=10), 0.25 * (times - 10).clamp(min=0), 0 * times], -1)
    return Trajectory(times, torch.eye(3).repeat(len(times), 1, 1), along.float())


def test_walked_distances_give_the_scale():
    scale, spread = scale_by_walks(straight_walk(), [(0.0, 8.0, 8.0), (10.0, 18.0, 4.08)])
    assert scale == pytest.approx(2.0, rel=0.01)
    assert spread == pytest.approx(0.02, rel=0.05)
    with pytest.raises(WearcapError, match="two different places"):
        scale_by_walks(straight_walk(), [(3.0, 3.0, 1.0)])
    with pytest.raises(WearcapError, match="no walked distance"):
        scale_by_walks(straight_walk(), [])


def test_standing_must_be_still_and_face_ahead():
    made = session(0)
    aligned = align_by_marks(mark_positions(made.slam, MARKS)[0], made.measured.distances_m).apply(made.slam)
    with pytest.raises(WearcapError, match="optical axis away from straight ahead: 1[5-8].*facing_deg"):
        require(mount_by_standing(aligned, STANDING, facing_deg=-90.0).checks())
    with pytest.raises(WearcapError, match="standing: not still"):
        require(HeadMount(torch.eye(3), torch.zeros(3), 9.0).checks())
    with pytest.raises(WearcapError, match="standing.*at least 3 s"):
        mount_by_standing(aligned, (52.0, 53.0))
