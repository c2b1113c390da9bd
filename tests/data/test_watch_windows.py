"""Windows of heads and wrists: their features do not depend on north or on the rate of a file, and mirrored windows have mirrored features."""

from dataclasses import replace

import pytest
import torch

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.skeleton import xsens23
from wearcap.data.transforms import Mirror, Scale, SensorErrors, Shift, StillStart, TimeStretch, Yaw, scaled, turned
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.systems.mocap_every.features import ENDS, Sensed, WatchFeatures
from wearcap.systems.mocap_every.training_windows import WatchContent, WatchWindow
from wearcap_testing import AlwaysMirrored, seeded, small_dataset, window_of

SKELETON = xsens23()


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return str(small_dataset(tmp_path_factory.mktemp("data")).root)


MOVED = {"shift": Shift(whole_frames=False), "stretch": TimeStretch(1.0)}
SEEN = {"yaw": Yaw(), "mirror": Mirror()}


def dataset(root: str, **transforms) -> Windows:
    settings = {"window": 40, "stride": 10, "fps": 30.0, "every": 2, "transforms": transforms}
    return Windows([Source(root)], "train", True, content=WatchContent(), **settings)


def changed(root: str, change, index: int = 0) -> WatchWindow:
    return window_of(dataset(root, change=change), index)


def batch(root: str, **settings) -> WatchWindow:
    windows = dataset(root, **settings)
    return windows.batch(torch.arange(8) % len(windows), torch.arange(8))


def encoded(features: WatchFeatures, window: WatchWindow) -> torch.Tensor:
    canonical = features.canonical(window.sensed, window.floor_height)
    return features.encode(window.sensed, window.floor_height, window.size, canonical)


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({"frame": "head"}, 31),
        ({"frame": "head", "absolute": False}, 27),
        ({"body": True}, 35),
        ({"frame": "world", "absolute": False}, 27),
        ({"wrists": "positions"}, 31),
        ({"frame": "own"}, 31),
        ({"frame": "own", "body": True}, 35),
    ],
)
def test_sizes_are_the_papers(root, settings, size):
    features = WatchFeatures(**{"frame": "heading"} | settings)
    assert features.size == size
    assert encoded(features, batch(root)).shape == (8, 40, size)


@pytest.mark.parametrize("frame", ["own", "heading", "head"])
def test_north_and_place_make_no_difference(root, frame):
    """All but the head's up-vector in the world, which the paper gives as it is."""
    features = WatchFeatures(frame=frame, absolute=frame != "head")
    window = window_of(dataset(root), 3)
    moved = changed(root, lambda batch: turned(batch, torch.tensor([1.3])), 3)
    moved = moved._replace(t_world_head=moved.t_world_head + torch.tensor([5.0, -3.0, 0.0]))
    here, there = (encoded(features, WatchWindow(*(part[None] for part in w))) for w in (window, moved))
    torch.testing.assert_close(here, there, atol=1e-4, rtol=0)


@pytest.mark.parametrize("frame", ["own", "heading", "head", "world"])
@pytest.mark.parametrize("where", ["head", "window"])
def test_motion_comes_back_as_it_went_in(root, frame, where):
    features, window = WatchFeatures(frame=frame, root=where), batch(root)
    canonical = features.canonical(window.sensed, window.floor_height)
    code = features.encode_motion(window.R_parent_joint, window.t_world_root, window.sensed, canonical)
    assert code.shape[-1] == features.motion_size == 3 + 6 * 23
    R, t = features.decode_motion(code, window.sensed, canonical)
    torch.testing.assert_close(R, window.R_parent_joint, atol=1e-4, rtol=0)
    torch.testing.assert_close(t, window.t_world_root, atol=1e-4, rtol=0)
    last = features.decode_motion(code[:, -5:], window.sensed, canonical)
    torch.testing.assert_close(last[1], window.t_world_root[:, -5:], atol=1e-4, rtol=0)


def test_in_a_mirror_the_wrists_are_still_those_of_the_body(root):
    for window in (
        window_of(dataset(root)),
        changed(root, AlwaysMirrored()),
        changed(root, lambda batch: turned(batch, torch.tensor([2.0]))),
        changed(root, lambda batch: scaled(batch, torch.tensor([1.2]))),
    ):
        body = forward_kinematics(SKELETON, window.R_parent_joint, window.t_world_root, window.t_parent_joint[None])
        wrists = SKELETON.indices(*ENDS[:2])
        torch.testing.assert_close(body.R[:, wrists], window.R_world_wrist, atol=4e-4, rtol=0)
        torch.testing.assert_close(body.t[:, wrists], window.t_world_wrist, atol=4e-4, rtol=0)
        head = SKELETON.index("head")
        torch.testing.assert_close(body.t[:, head], window.t_world_head, atol=4e-4, rtol=0)


class Faster:
    """Every window at 1.25 times the speed."""

    def cut(self, batch):
        return replace(batch, speed=torch.full((len(batch.track),), 1.25), stretch=1.25)


def test_faster_windows_hold_more_of_the_recording_and_stronger_accelerations(root):
    fast, whole = window_of(dataset(root, faster=Faster()), 0), window_of(dataset(root), 0)
    torch.testing.assert_close(fast.t_world_root[28], whole.t_world_root[35], atol=1e-4, rtol=0)
    torch.testing.assert_close(fast.acc_world_wrist[28], 1.25**2 * whole.acc_world_wrist[35], atol=1e-4, rtol=0)


def test_windows_are_functions_of_their_seed(root):
    errors = SensorErrors(1.0, 2.0, 0.1, 0.02)
    moved = MOVED | {"stretch": TimeStretch(1.2), "beginnings": StillStart(0.5), "scale": Scale(1.1)}
    windows = dataset(root, **moved, **SEEN, errors=errors)
    several = seeded(windows, 1, 9)
    for one, two in zip(window_of(windows, 1, 7), several):
        torch.testing.assert_close(one, two[7], atol=1e-6, rtol=1e-5)
    assert not torch.equal(several.R_world_wrist[7], several.R_world_wrist[8])
    plain = seeded(dataset(root), 1, 9)
    assert torch.equal(plain.R_world_wrist[7], plain.R_world_wrist[8])


def test_errors_are_those_of_the_variation(root):
    plain = dataset(root, **MOVED, **SEEN)
    wrong = dataset(root, **MOVED, yaw=Yaw(), errors=SensorErrors(wrist_deg=3.0), mirror=Mirror())
    a, b = seeded(plain, 0, 40), seeded(wrong, 0, 40)
    off = a.R_world_wrist.mT @ b.R_world_wrist
    torch.testing.assert_close(off, off[:, :1].expand_as(off), atol=1e-4, rtol=0)
    angles = torch.arccos(((off[:, 0].diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)).rad2deg()
    assert 3.0 < angles.mean() < 6.5  # √(8/π) · 3 degrees
    torch.testing.assert_close(a.R_parent_joint, b.R_parent_joint)


def test_a_beginning_stands_still(root):
    windows = dataset(root, **MOVED, **SEEN, beginnings=StillStart(1.0))
    held = (seeded(windows, 0, 20).t_world_head.diff(dim=1).abs().amax(-1) == 0).sum(1)
    assert held.max() > 10
    assert held.min() < 30


@pytest.mark.parametrize("wrong", [{"frame": "moon"}, {"wrists": "gloves"}, {"root": "tree"}])
def test_unknown_settings(wrong):
    with pytest.raises(WearcapError, match="watch features have no"):
        WatchFeatures(**{"frame": "heading"} | wrong)


def test_another_rate_is_refused(root):
    with pytest.raises(WearcapError, match="frames per second"):
        Windows([Source(root)], "train", content=WatchContent(), window=40, stride=10, fps=30.0)


def test_sensed_is_the_first_half_of_a_window(root):
    window = batch(root)
    assert isinstance(window.sensed, Sensed)
    assert window.sensed.t_world_wrist is window.t_world_wrist
