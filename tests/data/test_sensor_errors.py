"""Errors of trackers and watches in training windows: what each changes, how much, and that none changes nothing."""

import pytest
import torch

from wearcap.data.transforms import Draws, SensorErrors, WatchErrors, Window
from wearcap.data.windows import Source, Windows
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.sensors.imu import GRAVITY, acceleration, mean_filter
from wearcap.sensors.simulated import SlamNoise
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


def wrong(values: dict[str, torch.Tensor], seed: int = 0, **errors: float) -> dict[str, torch.Tensor]:
    return errors_of(**errors)(Window(values, fps=FPS), Draws(seed)).values


def angle_deg(R: torch.Tensor) -> torch.Tensor:
    return rotation.log(R).norm(dim=-1).rad2deg()


def test_no_error_changes_nothing(root):
    for one, two in zip(watched(root)[(1, 3)], watched(root, **dict.fromkeys(CHANGES, 0.0))[(1, 3)]):
        assert torch.equal(one, two)


def test_no_error_draws_nothing():
    """Windows with the errors of before have the same random numbers as before."""
    one, two = Draws(5), Draws(5)
    window = Window(walk(), fps=FPS)
    SensorErrors(head_deg=1.0, acc_m_s2=0.1)(window, one)
    for shape in ((3, 3), window.values["acc_world_wrist"].shape, (1,), (3, 3)):
        torch.randn(shape, generator=two.generator)
    assert one.uniform("next") == two.uniform("next")


@pytest.mark.parametrize("error", list(CHANGES))
def test_an_error_changes_what_a_sensor_gives_and_nothing_else(root, error):
    size = {"silent": 1.0}.get(error, 0.05)
    plain, window = watched(root)[(1, 3)], watched(root, **{error: size})[(1, 3)]
    changed = {name for name, one, two in zip(WatchWindow._fields, plain, window) if not torch.equal(one, two)}
    assert changed == CHANGES[error]
    again = watched(root, **{error: size})[(1, 3)]
    assert all(torch.equal(one, two) for one, two in zip(window, again))


def test_gravity_of_the_head_is_off_about_a_horizontal_axis_through_its_first_place():
    true, angles = walk(), []
    for seed in range(60):
        sensed = wrong(true, seed, tilt_deg=2.0)
        turn = sensed["R_world_head"] @ true["R_world_head"].mT
        torch.testing.assert_close(turn, turn[:1].expand_as(turn), atol=1e-5, rtol=0)
        assert rotation.log(turn[0])[2].abs() < 1e-5
        for name in ("t_world_head", "t_world_wrist"):
            ways = [(values[name] - true["t_world_head"][0])[..., None] for values in (true, sensed)]
            shape = (FRAMES, 3, 3) if name == "t_world_head" else (FRAMES, 1, 3, 3)
            torch.testing.assert_close(turn.reshape(shape) @ ways[0], ways[1], atol=1e-4, rtol=0)
        angles.append(angle_deg(turn[0]))
    assert 1.6 < torch.stack(angles).square().mean().sqrt() < 2.4


def test_a_tracked_head_jitters_and_drifts():
    true = walk()
    seeds = [wrong(true, seed, jitter_m=0.002, jitter_deg=0.2) for seed in range(40)]
    off = torch.stack([sensed["t_world_head"] - true["t_world_head"] for sensed in seeds])
    turned = torch.stack([angle_deg(true["R_world_head"].mT @ sensed["R_world_head"]) for sensed in seeds])
    assert 0.0017 < off.square().mean().sqrt() < 0.0023
    assert 0.3 < turned.square().mean().sqrt() < 0.4  # √3 · 0.2 degrees
    assert off.diff(dim=1).square().mean() < 0.1 * off.square().mean()
    drifted = torch.stack([(wrong(true, k, drift=0.01)["t_world_head"] - true["t_world_head"]) for k in range(60)])
    assert drifted[:, 0].abs().max() == 0
    assert 0.009 < drifted[:, -1].square().mean().sqrt() < 0.014  # 2 m: √2 cm, smoothed at the end


def test_points_that_are_tracked_from_the_head_keep_their_places_beside_it():
    walked = walk()
    true = {
        f"{kind}_world_point": torch.cat([walked[f"{kind}_world_head"][:, None], walked[f"{kind}_world_wrist"]], 1)
        for kind in "Rt"
    }
    sensed = wrong(true, tilt_deg=2.0, jitter_m=0.01, jitter_deg=1.0, drift=0.1)
    seen = []
    for values in (true, sensed):
        points = Rigid(values["R_world_point"], values["t_world_point"])
        head = Rigid(points.R[:, :1], points.t[:, :1])
        seen.append(head.inverse() @ points)
    torch.testing.assert_close(seen[0].t, seen[1].t, atol=1e-5, rtol=0)
    torch.testing.assert_close(seen[0].R, seen[1].R, atol=1e-5, rtol=0)
    alone = wrong(walked, tilt_deg=2.0, jitter_m=0.01, jitter_deg=1.0, drift=0.1)
    for kind in "Rt":
        torch.testing.assert_close(sensed[f"{kind}_world_point"][:, 0], alone[f"{kind}_world_head"])
    assert (true["t_world_point"] - sensed["t_world_point"]).abs().max() > 0.005


def test_gravity_that_is_off_looks_like_acceleration():
    still = walk() | {"acc_world_wrist": torch.zeros(FRAMES, 2, 3)}
    tilts, leaks = [], []
    for seed in range(40):
        sensed = wrong(still, seed, watch_tilt_deg=2.0)
        turn = sensed["R_world_wrist"] @ still["R_world_wrist"].mT
        torch.testing.assert_close(turn, turn[:1].expand_as(turn), atol=1e-5, rtol=0)
        assert rotation.log(turn[0])[:, 2].abs().max() < 1e-5
        tilts.append(angle_deg(turn[0]))
        leaks.append(sensed["acc_world_wrist"][0].norm(dim=-1))
    tilts, leaks = torch.stack(tilts), torch.stack(leaks)
    assert 2.5 < tilts.square().mean().sqrt() < 3.2  # √2 · 2 degrees
    torch.testing.assert_close(leaks, 2 * GRAVITY * (tilts.deg2rad() / 2).sin(), atol=1e-4, rtol=0)


def test_a_bias_is_constant_in_the_watchs_axes():
    true, found = walk(), []
    for seed in range(40):
        off = (wrong(true, seed, bias_m_s2=0.1)["acc_world_wrist"] - true["acc_world_wrist"])[..., None]
        bias = (true["R_world_wrist"].mT @ off)[..., 0]
        torch.testing.assert_close(bias, bias[:1].expand_as(bias), atol=1e-4, rtol=0)
        found.append(bias[0])
    assert 0.08 < torch.stack(found).square().mean().sqrt() < 0.12


def test_a_strap_gives_under_acceleration_by_no_more_than_it_can():
    pushed = torch.linspace(0, 100, FRAMES)[:, None, None].expand(-1, 2, 3)
    true = walk() | {"acc_world_wrist": pushed}
    play = angle_deg(true["R_world_wrist"].mT @ wrong(true, play_deg=3.0)["R_world_wrist"])
    assert play[0].max() < 0.01
    assert 2.5 < play.max() < 3.001


def test_a_delayed_watch_gives_what_was_before():
    true = walk()
    delays = []
    for seed in range(40):
        sensed = wrong(true, seed, delay_s=0.05)
        inside = slice(10, FRAMES - 10)
        late = (true["acc_world_wrist"] - sensed["acc_world_wrist"])[inside, :, 0]  # a frame gives 1 m/s²
        torch.testing.assert_close(late, late[:1].expand_as(late), atol=1e-4, rtol=0)
        speed = torch.tensor([1.0, 0.5]) / FPS
        behind = rotation.log(sensed["R_world_wrist"].mT @ true["R_world_wrist"]).norm(dim=-1)[inside] / speed
        torch.testing.assert_close(behind, late.abs(), atol=0.05, rtol=0)
        delays.append(late[0])
    assert 1.1 < torch.stack(delays).std() < 1.9  # 0.05 s are 1.5 frames


def test_a_silent_watch_keeps_its_last_orientation_without_acceleration():
    true = walk()
    true["acc_world_wrist"] = true["acc_world_wrist"] + 1
    counts = []
    for seed in range(20):
        sensed = wrong(true, seed, silent=1.0)
        silent = (sensed["acc_world_wrist"] == 0).all(-1)
        for wrist in range(2):
            gap = silent[:, wrist].nonzero()[:, 0]
            counts.append(len(gap))
            if len(gap):
                assert len(gap) == gap[-1] - gap[0] + 1
                assert len(gap) >= 15 or gap[-1] == FRAMES - 1
                last = true["R_world_wrist"][gap[0] - 1, wrist]
                assert torch.equal(sensed["R_world_wrist"][gap, wrist], last.expand(len(gap), 3, 3))
        for name in WATCHES:
            assert torch.equal(sensed[name][~silent], true[name][~silent])
    assert max(counts) > 30
    some = [bool((wrong(true, k, silent=0.2)["acc_world_wrist"] == 0).any()) for k in range(100)]
    assert 20 < sum(some) < 55  # 1 - 0.8², less those at a window's end


def test_a_watch_farther_up_the_arm_has_the_acceleration_of_that_place():
    true = walk()
    sensed = wrong(true, wrist_m=0.05)
    moved = (sensed["t_world_wrist"] - true["t_world_wrist"]).flatten(1)
    expected = mean_filter(acceleration(moved, FPS), 7)
    off = (sensed["acc_world_wrist"] - true["acc_world_wrist"]).flatten(1)
    assert off.abs().max() > 0.01
    torch.testing.assert_close(off, expected, atol=2e-3, rtol=0)
