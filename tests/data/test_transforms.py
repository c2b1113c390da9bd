"""What every augmentation does, on the windows of every system."""

import pytest
import torch

from carried_box import carried_dataset, small_features
from contact_motion import CLASSES, bending_dataset
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.data.motion_features import MotionFeatures, MovementContent
from wearcap.data.surroundings import PlaceCodes
from wearcap.data.transforms import (
    Draws,
    DropFrames,
    EarlyEnd,
    Mirror,
    Scale,
    SensorErrors,
    Shift,
    StillStart,
    TimeStretch,
    Yaw,
    mirrored,
    scaled,
    turned,
)
from wearcap.data.windows import Source, Windows, collate
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.systems.echo.training_windows import EchoContent
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.training_windows import HeadContent
from wearcap.systems.ireplica.features import HandViews
from wearcap.systems.ireplica.training_windows import ContactContent
from wearcap.systems.mocap_every.training_windows import WatchContent
from wearcap_testing import small_dataset

SYSTEMS = ("hmd2", "mocap_every", "echo", "ireplica", "motion_autoencoder")
SKELETON = xsens23()
RANDOM = {"noise", "level", "chance"}
"""Fields that are drawn after an augmentation."""


@pytest.fixture(scope="module")
def roots(tmp_path_factory) -> dict[str, str]:
    walking = str(small_dataset(tmp_path_factory.mktemp("walking")).root)
    bending = str(bending_dataset(tmp_path_factory.mktemp("bending")).root)
    carried = str(carried_dataset(tmp_path_factory.mktemp("carried")))
    return dict.fromkeys(SYSTEMS, walking) | {"ireplica": bending, "echo": carried}


def windows(roots: dict[str, str], system: str, **transforms) -> Windows:
    content, settings = {
        "hmd2": (HeadContent(), {"window": 30, "fps": 60.0}),
        "mocap_every": (WatchContent(), {"window": 20, "fps": 30.0, "every": 2}),
        "echo": (EchoContent(small_features(), None), {"window": 12, "fps": 30.0, "every": None}),
        "ireplica": (ContactContent(HandViews(), CLASSES, 60.0), {"window": 30, "fps": 60.0}),
        "motion_autoencoder": (MovementContent(MotionFeatures(SKELETON)), {"window": 30, "fps": 60.0}),
    }[system]
    settings |= {"stride": 4, "transforms": transforms}
    return Windows([Source(roots[system])], "train", True, content=content, **settings)


def applied(change):
    return lambda window, random: change(window)


def differ(one: tuple, two: tuple) -> set[str]:
    """Names of the fields in which two windows differ."""
    return {name for name, a, b in zip(one._fields, one, two) if not torch.allclose(a.float(), b.float(), atol=1e-5)}


@pytest.mark.parametrize("system", SYSTEMS)
def test_everything_together_is_a_function_of_the_seed(roots, system):
    every = {
        "shift": Shift(),
        "stretch": TimeStretch(1.2),
        "drop": DropFrames(0.3),
        "ending": EarlyEnd(0.5, 5),
        "beginning": StillStart(0.5),
        "scale": Scale(1.2),
        "yaw": Yaw(),
        "errors": SensorErrors(1.0, 1.0, 0.1, 0.01),
        "mirror": Mirror(),
    }
    varied = windows(roots, system, **every)
    assert not differ(varied[(2, 7)], varied[(2, 7)])
    assert differ(varied[(2, 7)], varied[(2, 8)])
    batch = collate([varied[(k % len(varied), k)] for k in range(12)])
    assert all(part.isfinite().all() for part in batch if part.is_floating_point())


@pytest.mark.parametrize("system", SYSTEMS)
def test_two_mirrors_and_two_opposite_turns_change_nothing(roots, system):
    plain = windows(roots, system)[(1, 3)]
    for change in (
        lambda w: mirrored(mirrored(w)),
        lambda w: turned(turned(w, 1.3), -1.3),
        lambda w: scaled(scaled(w, 2.0), 0.5),
    ):
        assert not differ(plain, windows(roots, system, change=applied(change))[(1, 3)])
    assert differ(plain, windows(roots, system, change=applied(mirrored))[(1, 3)])


def test_a_turned_world_leaves_features_relative_to_the_heading(roots):
    plain, other = (windows(roots, "hmd2", **more)[(1, 3)] for more in ({}, {"yaw": Yaw()}))
    assert differ(plain, other) - RANDOM == {"R_parent_joint", "R_world_head", "t_world_head"}
    features = HeadFeatures(contacts=True)
    for encode in (
        lambda w: features.condition(w.R_world_head, w.t_world_head, w.floor_height, w.size, 60.0),
        lambda w: features.encode(w.R_parent_joint, w.R_world_head, w.foot_contact),
    ):
        torch.testing.assert_close(encode(collate([plain])), encode(collate([other])), atol=1e-4, rtol=0)


@pytest.mark.parametrize("change", [mirrored, lambda w: turned(w, 2.0), lambda w: scaled(w, 1.3)])
def test_points_stay_on_the_body(roots, change):
    """Head and wrists are where the pose puts them, and contacts belong to the object's pose."""
    window = windows(roots, "echo", change=applied(change))[1]
    body = forward_kinematics(SKELETON, *window.body, window.t_parent_joint[None])
    joints = SKELETON.indices("head", "left_wrist", "right_wrist")
    torch.testing.assert_close(body.t[:, joints], window.t_world_point, atol=1e-4, rtol=0)
    torch.testing.assert_close(body.R[:, joints], window.R_world_point, atol=1e-4, rtol=0)


def test_a_larger_world_has_a_larger_object(roots):
    plain, larger = (windows(roots, "echo", **more)[1] for more in ({}, {"s": applied(lambda w: scaled(w, 2.0))}))
    classes = len(small_features().classes)
    torch.testing.assert_close(larger.object_code[:, classes : classes + 6], 2 * plain.object_code[:, classes:][:, :6])
    assert torch.equal(larger.object_code[:, :classes], plain.object_code[:, :classes])
    torch.testing.assert_close(larger.object_spread, 4 * plain.object_spread)
    torch.testing.assert_close(larger.t_world_object, 2 * plain.t_world_object)


def test_a_larger_wearer_has_longer_limbs_and_a_lower_floor(roots):
    plain, larger = (windows(roots, "hmd2", **more)[1] for more in ({}, {"s": applied(lambda w: scaled(w, 1.5))}))
    torch.testing.assert_close(larger.size, 1.5 * plain.size)
    torch.testing.assert_close(larger.t_world_head, 1.5 * plain.t_world_head)
    torch.testing.assert_close(
        larger.t_world_head[:, 2] - larger.floor_height, 1.5 * (plain.t_world_head[:, 2] - plain.floor_height)
    )
    torch.testing.assert_close(larger.R_parent_joint, plain.R_parent_joint)


def test_codes_of_points_cannot_be_scaled(roots):
    data = windows(roots, "hmd2", scale=Scale())
    data.content.conditions = {"points": PlaceCodes("none")}
    with pytest.raises(WearcapError, match="codes of points cannot be scaled"):
        data[0]


@pytest.mark.parametrize("system", ["hmd2", "mocap_every", "echo", "motion_autoencoder"])
def test_stretched_windows_stay_on_the_path(roots, system):
    """Every position lies on the recording's path, between the two frames that the speed leads to."""
    name = {"hmd2": "t_world_head", "motion_autoencoder": "joints", "echo": "t_world_point"}.get(system, "t_world_root")
    stretched, plain = windows(roots, system, stretch=TimeStretch(1.25)), windows(roots, system)
    speed = 1.25 ** (2 * Draws(5, plain.content.draws).uniform("speed") - 1)
    slow, true = (getattr(data[(0, 5)], name) for data in (stretched, plain))
    count = min(len(true) - 1, int((len(true) - 1) / speed))
    at = speed * torch.arange(count)
    low, share = at.long(), (at - at.long()).reshape(-1, *[1] * (true.ndim - 1))
    torch.testing.assert_close(slow[:count], torch.lerp(true[low], true[low + 1], share), atol=1e-3, rtol=0)


def test_dropped_frames_are_missing_in_what_was_sensed_alone(roots):
    plain, dropped = windows(roots, "hmd2"), windows(roots, "hmd2", drop=DropFrames(0.9))
    changed = [differ(plain[(k, k)], dropped[(k, k)]) for k in range(8)]
    assert set().union(*changed) - RANDOM <= {"R_world_head", "t_world_head", "floor_height", "floor_from_head"}
    assert any("R_world_head" in names for names in changed)
    head = dropped[(3, 3)].R_world_head
    torch.testing.assert_close(head @ head.mT, torch.eye(3).expand_as(head), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("system", "name"), [("hmd2", "R_world_head"), ("echo", "R_world_point")])
def test_errors_of_a_tracker_are_constant_and_leave_the_truth(roots, system, name):
    plain, wrong = (windows(roots, system, **more)[(1, 4)] for more in ({}, {"e": SensorErrors(head_deg=3.0)}))
    assert torch.equal(plain.R_parent_joint, wrong.R_parent_joint)
    off = getattr(plain, name).mT @ getattr(wrong, name)
    torch.testing.assert_close(off, off[:1].expand_as(off), atol=1e-5, rtol=0)
    head = off[0] if system == "hmd2" else off[0, 0]
    assert 0.1 < rotation.geodesic(head, torch.eye(3)).rad2deg() < 15
    if system == "echo":
        torch.testing.assert_close(off[:, 1:], torch.eye(3).expand_as(off[:, 1:]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("system", ["hmd2", "echo"])
def test_an_early_end_is_padding_and_a_still_start_is_not(roots, system):
    name = "t_world_head" if system == "hmd2" else "t_world_point"
    ended, begun = windows(roots, system, e=EarlyEnd(1.0, 4)), windows(roots, system, b=StillStart(1.0))
    for seed in range(6):
        window = ended[(1, seed)]
        last = int(window.valid.sum()) - 1
        assert 3 <= last < len(window.valid) - 1
        part = getattr(window, name)
        assert torch.equal(part[last:], part[last : last + 1].expand_as(part[last:]))
        assert begun[(1, seed)].valid.all()
    still = [int((getattr(begun[(1, k)], name).flatten(1).diff(dim=0).abs().amax(1) == 0).sum()) for k in range(10)]
    assert max(still) > len(window.valid) // 2


def test_without_augmentation_transforms_do_nothing(roots):
    plain = windows(roots, "hmd2")
    settings = {"content": HeadContent(), "window": 30, "stride": 4, "fps": 60.0, "transforms": {"yaw": Yaw()}}
    quiet = Windows([Source(roots["hmd2"])], "train", False, **settings)
    assert not differ(plain[(1, 3)], quiet[(1, 3)])
