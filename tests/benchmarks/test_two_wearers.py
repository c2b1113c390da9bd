"""Two simulated wearers share a world and a clock, and face each other."""

import pytest
import torch

from benchmarks.tables import two_wearers
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearsim.recordings.simulate import SimulationConfig

simulate_two_wearers = two_wearers.simulate_two_wearers
CONFIG = SimulationConfig(duration_s=3.0, points=False, suit=None, world="flat")


@pytest.fixture(scope="module")
def pair():
    return simulate_two_wearers(CONFIG, "talk", "val", 3, distance_m=2.0)


def test_they_share_session_world_and_clock(pair):
    assert [recording.name for recording in pair] == ["talk-a", "talk-b"]
    assert {recording.session for recording in pair} == {"talk"}
    a, b = pair
    assert a.location == b.location
    assert a.subject != b.subject
    assert torch.equal(a.motion.timestamps, b.motion.timestamps)
    assert torch.equal(a.camera.timestamps, b.camera.timestamps)
    assert a.camera.timestamps.diff().median() == pytest.approx(1 / 30)


def test_they_begin_face_to_face_on_one_floor(pair):
    a, b = pair
    between = b.motion.t_world_root[0] - a.motion.t_world_root[0]
    assert between[:2].norm() == pytest.approx(2.0, abs=1e-4)
    ahead = rotation.yaw_of(a.motion.R_parent_joint[0, 0])
    assert torch.atan2(between[1], between[0]) == pytest.approx(ahead.item(), abs=1e-4)
    turned = rotation.wrap_angle(rotation.yaw_of(b.motion.R_parent_joint[0, 0]) - ahead)
    assert turned.abs() == pytest.approx(torch.pi, abs=1e-4)
    assert a.floor.height[0] == pytest.approx(b.floor.height[0].item(), abs=1e-4)


def test_sensors_go_with_the_shifted_motion(pair):
    for recording in pair:
        off = recording.head.T_world_head.t - recording.motion.joint("head").t
        assert off.norm(dim=-1).max() < 0.02
        feet = recording.motion.joint("left_toe").t[:, 2] - recording.floor.height
        assert feet.min() > -0.05


def test_a_seed_determines_everything_and_no_camera_films(pair):
    again = simulate_two_wearers(CONFIG, "talk", "val", 3, distance_m=2.0)
    for one, other in zip(pair, again):
        assert torch.equal(one.motion.t_world_root, other.motion.t_world_root)
    with pytest.raises(WearcapError, match="camera=false"):
        simulate_two_wearers(SimulationConfig(camera=True), "talk", "val", 3)
