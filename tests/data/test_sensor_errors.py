"""Errors of trackers and watches in training windows: what each changes, how much, and that none changes nothing."""

import numpy as np
import pytest
import torch

from benchmarks.rivals.single_windows import transforms as before
from drawn_windows import one, single
from wearcap.data.batch import Batch
from wearcap.data.draws import Draws
from wearcap.data.packing import Packed, Track, joined
from wearcap.data.transforms import SensorErrors, WatchErrors, slam_paths
from wearcap.data.windows import Source, Windows
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.sensors.imu import GRAVITY
from wearcap.sensors.simulated import SlamNoise, slam_poses
from wearcap.systems.mocap_every.training_windows import WatchContent, WatchWindow
from wearcap_testing import small_dataset

FPS, FRAMES = 30.0, 60
HEAD = {"R_world_head", "t_world_head", "t_world_wrist"}
WATCHES = {"R_world_wrist", "acc_world_wrist"}
CHANGES = {
    "tilt_deg": HEAD,
    "jitter_m": {"t_world_head", "t_world_wrist"},
    "jitter_deg": {"R_world_head", "t_world_wrist"},
    "drift": {"t_world_head", "t_world_wrist"},
    "wrist_m": {"t_world_wrist", "acc_world_wrist"},
    "watch_tilt_deg": WATCHES,
    "bias_m_s2": {"acc_world_wrist"},
    "play_deg": {"R_world_wrist"},
    "delay_s": WATCHES,
    "silent": WATCHES,
}
"""What the windows of MocapEvery differ in, by the error."""


SLAM = {"tilt_deg": "lean_deg", "jitter_m": "jitter_m", "jitter_deg": "jitter_deg", "drift": "drift_share"}
WATCH = {name: name for name in ("bias_m_s2", "play_deg", "delay_s", "silent")} | {"watch_tilt_deg": "tilt_deg"}
"""Names of errors within their groups."""


def errors_of(**errors: float) -> SensorErrors:
    """Errors by their own names, whichever group they are in."""
    slam, watches = ({names[one]: errors.pop(one) for one in [*errors] if one in names} for names in (SLAM, WATCH))
    path = SlamNoise(**{"jitter_m": 0.0, "jitter_deg": 0.0} | slam) if any(slam.values()) else None
    return SensorErrors(**errors, slam=path, watches=WatchErrors(**watches))


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> str:
    return str(small_dataset(tmp_path_factory.mktemp("data")).root)


def watched(root: str, **errors: float) -> Windows:
    transforms = {"errors": errors_of(**errors)} if errors else {}
    settings = {"window": 40, "stride": 10, "fps": FPS, "every": 2, "transforms": transforms}
    return Windows([Source(root)], "train", True, content=WatchContent(), **settings)


def walk() -> dict[str, torch.Tensor]:
    """A head that walks along x at 1 m/s and turns, and wrists that turn, with accelerations that grow by 1 m/s² a frame."""
    time = torch.arange(FRAMES) / FPS
    ahead, up = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.6])
    turn = torch.stack([rotation.about_axis("z", time), rotation.about_axis("x", 0.5 * time)], 1)
    return {
        "R_world_head": rotation.about_axis("z", 0.3 * time),
        "t_world_head": time[:, None] * ahead + up,
        "R_world_wrist": turn,
        "acc_world_wrist": torch.arange(FRAMES)[:, None, None].expand(-1, 2, 3).float(),
        "t_world_wrist": (time[:, None] * ahead + up)[:, None].expand(-1, 2, -1) - 0.5,
    }


def batch_of(values: dict[str, torch.Tensor], count: int, draws: Draws | None = None) -> Batch:
    """Windows that are all the same, with further seeds."""
    packed, zeros = (
        Packed(*joined([Track({"none": torch.zeros(FRAMES)})], ["one"])),
        torch.zeros(count, dtype=torch.long),
    )
    values = {name: value.expand(count, *value.shape) for name, value in values.items()}
    return Batch(packed, draws or Draws(torch.arange(count)), zeros, zeros, FRAMES, FPS, values=values)


def wrong(values: dict[str, torch.Tensor], count: int = 1, **errors: float) -> dict[str, torch.Tensor]:
    """Values of `count` windows, each with errors of its own."""
    return errors_of(**errors)(batch_of(values, count)).values


def angle_deg(R: torch.Tensor) -> torch.Tensor:
    return rotation.log(R).norm(dim=-1).rad2deg()


class SameDraws(Draws):
    """The numbers that windows of before, with all errors, drew one after another."""

    ORDER = (
        ("strap", (2, 2, 3)),
        ("watch delay", (2,)),
        ("turned", (3, 3)),
        ("acceleration", (FRAMES, 2, 3)),
        ("floor", (1,)),
        ("seat", (3, 3)),
        ("size", (5,)),
        ("watch tilt", (2, 3)),
        ("watch bias", (2, 3, 1)),
    )

    def __init__(self, count: int):
        super().__init__(torch.arange(count))
        rows = []
        for seed in range(count):
            generator = torch.Generator().manual_seed(seed)
            row = {name: torch.randn(shape, generator=generator) for name, shape in self.ORDER}
            row["watch silence"] = torch.rand(3, 2, generator=generator)
            row["watch tilt"] = row["watch tilt"][:, :2]
            for kind in ("turned", "seat"):
                row[f"wrist {kind}"], row[f"head {kind}"] = row[kind].split([2, 1])
            rows.append(row)
        self.numbers = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}

    def normal(self, name: str, *shape: int) -> torch.Tensor:
        return self.numbers[name].reshape(-1, *shape)

    uniform = normal


@pytest.mark.parametrize("points", [False, True])
def test_all_errors_are_those_of_each_window_on_its_own(points):
    """Given the same random numbers; the errors of a tracked path have distributions of their own, below."""
    values = walk() | {"floor_height": torch.zeros(FRAMES), "size": torch.ones(5)}
    if points:
        values |= {"R_world_point": values["R_world_wrist"][:, [0, 1, 1]], "t_world_point": torch.zeros(FRAMES, 3, 3)}
    watches = {"tilt_deg": 3.0, "bias_m_s2": 0.2, "play_deg": 4.0, "delay_s": 0.05, "silent": 0.4}
    sizes = {
        "head_deg": 2.0,
        "wrist_deg": 5.0,
        "acc_m_s2": 0.3,
        "floor_m": 0.1,
        "head_m": 0.02,
        "wrist_m": 0.03,
        "size": 0.1,
    }
    batch = batch_of(values, 20, SameDraws(20))
    found = SensorErrors(**sizes, watches=WatchErrors(**watches))(batch).values
    older = before.SensorErrors(**sizes, watches=before.WatchErrors(**watches))
    for number in range(20):
        expected = older(single(batch, number), before.Draws(number)).values
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(found[name][number], value, atol=3e-4, rtol=1e-4)


NOISES = {
    "jitter": SlamNoise(jitter_m=0.01, jitter_deg=1.0),
    "quick jitter": SlamNoise(jitter_m=0.01, jitter_deg=1.0, jitter_period_s=0.02),
    "drift": SlamNoise(0.0, 0.0, drift_share=0.05),
    "yaw": SlamNoise(0.0, 0.0, yaw_drift_deg_per_sqrt_min=20.0),
    "wander": SlamNoise(0.0, 0.0, wander_m=0.02, wander_deg=2.0, wander_period_s=1.0),
    "lean": SlamNoise(0.0, 0.0, lean_deg=2.0),
    "scale": SlamNoise(0.0, 0.0, scale=0.05),
}


@pytest.mark.parametrize("name", NOISES)
def test_tracked_paths_are_distributed_as_those_of_simulated_sensors(name):
    """Deviations at the beginning, the middle and the end, and of steps between frames, of 400 paths each."""
    values, noise, count = walk(), NOISES[name], 400
    true = Rigid(values["R_world_head"], values["t_world_head"])
    many = Rigid(true.R.expand(count, *true.R.shape), true.t.expand(count, *true.t.shape))
    found = slam_paths(many, FPS, noise, Draws(torch.arange(count)))
    alone = [slam_poses(true, FPS, noise, np.random.default_rng(seed))[0] for seed in range(count)]
    spread = []
    for R, t in ((found.R, found.t), (torch.stack([T.R for T in alone]), torch.stack([T.t for T in alone]))):
        off = torch.cat([t - true.t, rotation.log(R @ true.R.mT)], -1)
        assert off.mean(0).abs().max() < 0.2 * off.std(0).max() + 1e-6
        spread.append(
            torch.cat([off[:, [0, FRAMES // 2, -1]].flatten(1), off.diff(dim=1)[:, [5, 40]].flatten(1)], 1).std(0)
        )
    torch.testing.assert_close(spread[0], spread[1], rtol=0.2, atol=0.02 * spread[1].max().item() + 1e-6)


def test_no_error_changes_nothing(root):
    plain, same = one(watched(root), 1, 3), one(watched(root, **dict.fromkeys(CHANGES, 0.0)), 1, 3)
    assert all(torch.equal(a, b) for a, b in zip(plain, same))


@pytest.mark.parametrize("error", list(CHANGES))
def test_an_error_changes_what_a_sensor_gives_and_nothing_else(root, error):
    size = {"silent": 1.0}.get(error, 0.05)
    plain, window, again = (one(watched(root, **errors), 1, 3) for errors in ({}, {error: size}, {error: size}))
    changed = {name for name in WatchWindow._fields if not torch.equal(getattr(plain, name), getattr(window, name))}
    assert changed == CHANGES[error]
    assert all(torch.equal(a, b) for a, b in zip(window, again))


def test_gravity_of_the_head_is_off_about_a_horizontal_axis_through_its_first_place():
    true, sensed = walk(), wrong(walk(), 400, tilt_deg=2.0)
    turn = sensed["R_world_head"] @ true["R_world_head"].mT
    torch.testing.assert_close(turn, turn[:, :1].expand_as(turn), atol=1e-5, rtol=0)
    assert rotation.log(turn[:, 0])[:, 2].abs().max() < 1e-5
    for name in ("t_world_head", "t_world_wrist"):
        ways = [(values[name] - true["t_world_head"][0])[..., None] for values in (true, sensed)]
        by = turn if name == "t_world_head" else turn[:, :, None]
        torch.testing.assert_close(by @ ways[0], ways[1], atol=1e-4, rtol=0)
    assert 1.85 < angle_deg(turn[:, 0]).square().mean().sqrt() < 2.15


def test_points_that_are_tracked_from_the_head_keep_their_places_beside_it():
    walked = walk()
    true = {
        f"{kind}_world_point": torch.cat([walked[f"{kind}_world_head"][:, None], walked[f"{kind}_world_wrist"]], 1)
        for kind in "Rt"
    }
    sensed = wrong(true, 3, tilt_deg=2.0, jitter_m=0.01, jitter_deg=1.0, drift=0.1)
    seen = []
    for values in (true, sensed):
        points = Rigid(values["R_world_point"], values["t_world_point"])
        head = Rigid(points.R[..., :1, :, :], points.t[..., :1, :])
        seen.append(head.inverse() @ points)
    for part in ("R", "t"):
        first, second = (getattr(each, part) for each in seen)
        torch.testing.assert_close(first.expand_as(second), second, atol=1e-5, rtol=0)
    alone = wrong(walked, 3, tilt_deg=2.0, jitter_m=0.01, jitter_deg=1.0, drift=0.1)
    for kind in "Rt":
        torch.testing.assert_close(sensed[f"{kind}_world_point"][:, :, 0], alone[f"{kind}_world_head"])
    assert (true["t_world_point"] - sensed["t_world_point"]).abs().max() > 0.005


def test_gravity_that_is_off_looks_like_acceleration():
    still = walk() | {"acc_world_wrist": torch.zeros(FRAMES, 2, 3)}
    sensed = wrong(still, 300, watch_tilt_deg=2.0)
    turn = sensed["R_world_wrist"] @ still["R_world_wrist"].mT
    torch.testing.assert_close(turn, turn[:, :1].expand_as(turn), atol=1e-5, rtol=0)
    assert rotation.log(turn[:, 0])[..., 2].abs().max() < 1e-5
    tilts, leaks = angle_deg(turn[:, 0]), sensed["acc_world_wrist"][:, 0].norm(dim=-1)
    assert 2.65 < tilts.square().mean().sqrt() < 3.0  # √2 · 2 degrees
    torch.testing.assert_close(leaks, 2 * GRAVITY * (tilts.deg2rad() / 2).sin(), atol=1e-4, rtol=0)


def test_a_bias_is_constant_in_the_watchs_axes():
    true = walk()
    off = wrong(true, 300, bias_m_s2=0.1)["acc_world_wrist"] - true["acc_world_wrist"]
    bias = (true["R_world_wrist"].mT @ off[..., None])[..., 0]
    torch.testing.assert_close(bias, bias[:, :1].expand_as(bias), atol=1e-4, rtol=0)
    assert 0.095 < bias[:, 0].square().mean().sqrt() < 0.105


def test_a_strap_gives_under_acceleration_by_no_more_than_it_can():
    pushed = torch.linspace(0, 100, FRAMES)[:, None, None].expand(-1, 2, 3)
    true = walk() | {"acc_world_wrist": pushed}
    play = angle_deg(true["R_world_wrist"].mT @ wrong(true, 20, play_deg=3.0)["R_world_wrist"])
    assert play[:, 0].max() < 0.01
    assert (play.amax((1, 2)) < 3.001).all()
    assert play.max() > 2.5


def test_a_delayed_watch_gives_what_was_before():
    true, inside = walk(), slice(10, FRAMES - 10)
    sensed = wrong(true, 300, delay_s=0.05)
    late = (true["acc_world_wrist"] - sensed["acc_world_wrist"])[:, inside, :, 0]  # a frame gives 1 m/s²
    torch.testing.assert_close(late, late[:, :1].expand_as(late), atol=1e-4, rtol=0)
    speed = torch.tensor([1.0, 0.5]) / FPS
    behind = rotation.log(sensed["R_world_wrist"].mT @ true["R_world_wrist"]).norm(dim=-1)[:, inside] / speed
    torch.testing.assert_close(behind, late.abs(), atol=0.05, rtol=0)
    assert 1.4 < late[:, 0].std() < 1.6  # 0.05 s are 1.5 frames
    assert abs(late[:, 0].mean()) < 0.2


def test_a_silent_watch_keeps_its_last_orientation_without_acceleration():
    true = walk()
    true["acc_world_wrist"] = true["acc_world_wrist"] + 1
    sensed = wrong(true, 20, silent=1.0)
    silence = (sensed["acc_world_wrist"] == 0).all(-1)
    for R, silent in zip(sensed["R_world_wrist"], silence):
        for wrist in range(2):
            gap = silent[:, wrist].nonzero()[:, 0]
            if len(gap):
                assert len(gap) == gap[-1] - gap[0] + 1
                assert len(gap) >= 15 or gap[-1] == FRAMES - 1
                last = true["R_world_wrist"][gap[0] - 1, wrist]
                assert torch.equal(R[gap, wrist], last.expand(len(gap), 3, 3))
    for name in WATCHES:
        assert torch.equal(sensed[name][~silence], true[name].expand_as(sensed[name])[~silence])
    assert silence.sum(1).max() > 30
    some = (wrong(true, 1000, silent=0.2)["acc_world_wrist"] == 0).flatten(1).any(1)
    assert 0.28 < some.double().mean() < 0.4  # 1 - 0.8², less those at a window's end
