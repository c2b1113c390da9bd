"""What every augmentation does, on the windows of every system, and as it did to each window on its own."""

import math
from dataclasses import replace

import pytest
import scipy.stats
import torch

from benchmarks.rivals.single_windows import transforms as before
from carried_box import carried_dataset, small_features
from contact_motion import CLASSES, bending_dataset
from drawn_windows import numbers, one, single
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.data.batch import Batch
from wearcap.data.motion_features import MotionFeatures, MovementContent
from wearcap.data.surroundings import PlaceCodes
from wearcap.data.transforms import (
    DropFrames,
    EarlyEnd,
    Mirror,
    Scale,
    SensorErrors,
    Shift,
    StillStart,
    TimeStretch,
    Yaw,
    scaled,
    turned,
)
from wearcap.data.windows import Source, Windows
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
        "motion_autoencoder": (MovementContent(MotionFeatures(SKELETON)), {"window": 10, "fps": 20.0, "every": 3}),
    }[system]
    settings |= {"stride": 4, "transforms": transforms}
    return Windows([Source(roots[system])], "train", True, content=content, **settings)


class Flip:
    """Mirrors all windows."""

    def cut(self, batch: Batch) -> Batch:
        return replace(batch, mirrored=torch.ones_like(batch.track, dtype=torch.bool))


def by(change, value: float):
    """A transform that turns or scales all windows alike."""
    return lambda batch: change(batch, torch.full(batch.track.shape, value))


def differ(a: tuple, b: tuple) -> set[str]:
    """Names of the fields in which two windows differ."""
    return {name for name, x, y in zip(a._fields, a, b) if not torch.allclose(x.float(), y.float(), atol=1e-5)}


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
    assert not differ(one(varied, 2, 7), one(varied, 2, 7))
    assert differ(one(varied, 2, 7), one(varied, 2, 8))
    batch = varied.batch(torch.arange(12) % len(varied), torch.arange(12))
    assert all(part.isfinite().all() for part in batch if part.is_floating_point())


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_batch_is_changed_as_each_window_on_its_own(roots, system):
    data, count = windows(roots, system), 5
    index, factor = torch.arange(count) % len(data), torch.linspace(0.5, 2, count)
    plain, flip = data.cut(index, index).read(), torch.arange(count) % 2 == 0
    mirrored = replace(data.cut(index, index), mirrored=flip).read()
    changed = mirrored, turned(data.cut(index, index).read(), 3 * factor), scaled(plain, factor)
    for k in range(count):
        window = single(plain, k)
        expected = (
            before.mirrored(window) if flip[k] else window,
            before.turned(window, 3 * factor[k].item()),
            before.scaled(window, factor[k].item()),
        )
        for found, right in zip(changed, expected):
            assert found.values.keys() == right.values.keys()
            for name, value in right.values.items():
                torch.testing.assert_close(found.values[name][k], value, atol=1e-5, rtol=1e-5)
    assert torch.equal(scaled(changed[2], factor).scale, factor.square())


DRAWN = {
    "shift": (Shift(), lambda b: b.later, lambda c: c.start - 100),
    "smooth shift": (Shift(False), lambda b: b.later, lambda c: c.start - 100),
    "stretch": (TimeStretch(1.3), lambda b: b.speed, lambda c: c.speed),
    "drop": (DropFrames(0.4), lambda b: (~b.kept).double().mean(1), lambda c: (~c.kept).double().mean()),
    "end": (EarlyEnd(0.6, 5), lambda b: b.end, lambda c: c.count if c.shown[1] is None else c.shown[1]),
    "begin": (StillStart(0.6), lambda b: b.begin, lambda c: c.shown[0]),
}


@pytest.mark.parametrize("name", DRAWN)
def test_frames_are_chosen_as_often_as_for_each_window_on_its_own(roots, name):
    transform, seen, seen_before = DRAWN[name]
    data, count = windows(roots, "hmd2"), 3000
    batch = transform.cut(replace(data.cut(numbers(0).repeat(count), torch.arange(count)), stride=50, stretch=1.29))
    found = seen(batch).double()
    older, same = (
        getattr(before, type(transform).__name__)(*vars(transform).values()),
        before.Cut(100, 30, 900, stride=50, stretch=1.29),
    )
    expected = torch.tensor([seen_before(older.retimed(same, before.Draws(k))) for k in range(count)]).double()
    assert scipy.stats.ks_2samp(found.numpy(), expected.numpy()).pvalue > 0.01
    assert found.mean().item() == pytest.approx(expected.mean().item(), abs=0.06 * expected.std().item())
    assert found.std().item() == pytest.approx(expected.std().item(), rel=0.05)
    if name == "drop":
        assert batch.kept[:, [0, -1]].all()


def test_windows_are_mirrored_turned_and_scaled_evenly(roots):
    data, count = windows(roots, "hmd2"), 3000
    batch = data.cut(numbers(0).repeat(count), torch.arange(count))
    assert Mirror().cut(batch).mirrored.double().mean().item() == pytest.approx(0.5, abs=0.03)
    batch = replace(batch, values={"R_world_head": torch.eye(3).repeat(count, 1, 1, 1)})
    angle = rotation.yaw_of(Yaw()(batch).values["R_world_head"][:, 0]) / (2 * torch.pi) + 0.5
    scale = Scale(1.2)(batch).scale.log() / math.log(1.2) / 2 + 0.5
    for share in (angle, scale):
        assert scipy.stats.kstest(share.numpy(), "uniform").pvalue > 0.01
    assert abs(torch.corrcoef(torch.stack([angle, scale]))[0, 1]) < 0.06


def test_a_turned_world_leaves_features_relative_to_the_heading(roots):
    chosen = numbers(1), numbers(3)
    plain, other = (windows(roots, "hmd2", **more).batch(*chosen) for more in ({}, {"yaw": Yaw()}))
    assert differ(plain, other) == {"R_parent_joint", "R_world_head", "t_world_head"}
    features = HeadFeatures(contacts=True)
    for encode in (
        lambda w: features.condition(w.R_world_head, w.t_world_head, w.floor_height, w.size, 60.0),
        lambda w: features.encode(w.R_parent_joint, w.R_world_head, w.foot_contact),
    ):
        torch.testing.assert_close(encode(plain), encode(other), atol=1e-4, rtol=0)


@pytest.mark.parametrize("change", [Flip(), by(turned, 2.0), by(scaled, 1.3)])
def test_points_stay_on_the_body(roots, change):
    """Head and wrists are where the pose puts them."""
    window = one(windows(roots, "echo", change=change), 1)
    body = forward_kinematics(SKELETON, window.R_parent_joint, window.t_world_root, window.t_parent_joint[None])
    joints = SKELETON.indices("head", "left_wrist", "right_wrist")
    torch.testing.assert_close(body.t[:, joints], window.t_world_point, atol=5e-4, rtol=0)
    torch.testing.assert_close(body.R[:, joints], window.R_world_point, atol=5e-4, rtol=0)


def test_a_larger_world_has_a_larger_object(roots):
    plain, larger = (one(windows(roots, "echo", **more), 1) for more in ({}, {"s": by(scaled, 2.0)}))
    classes = len(small_features().classes)
    torch.testing.assert_close(larger.object_code[:, classes : classes + 6], 2 * plain.object_code[:, classes:][:, :6])
    assert torch.equal(larger.object_code[:, :classes], plain.object_code[:, :classes])
    torch.testing.assert_close(larger.object_spread, 4 * plain.object_spread)
    torch.testing.assert_close(larger.t_world_object, 2 * plain.t_world_object)


def test_codes_of_points_cannot_be_scaled(roots):
    data = windows(roots, "hmd2", scale=Scale())
    data.content.conditions = {"points": PlaceCodes("none")}
    with pytest.raises(WearcapError, match="codes of points cannot be scaled"):
        one(data, 0)


def test_dropped_frames_are_missing_in_what_was_sensed_alone(roots):
    chosen = torch.arange(8)
    plain, dropped = (windows(roots, "hmd2", **more).batch(chosen, chosen) for more in ({}, {"drop": DropFrames(0.9)}))
    changed = differ(plain, dropped)
    assert "R_world_head" in changed
    assert changed <= {"R_world_head", "t_world_head", "floor_height", "floor_from_head"}
    head = dropped.R_world_head
    torch.testing.assert_close(head @ head.mT, torch.eye(3).expand_as(head), atol=1e-5, rtol=0)


def test_without_augmentation_transforms_do_nothing(roots):
    plain = windows(roots, "hmd2")
    settings = {"content": HeadContent(), "window": 30, "stride": 4, "fps": 60.0, "transforms": {"yaw": Yaw()}}
    quiet = Windows([Source(roots["hmd2"])], "train", False, **settings)
    assert not differ(one(plain, 1, 3), one(quiet, 1, 3))
