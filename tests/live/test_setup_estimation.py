"""The first minute: planted heights, floors, sides, seats, headings and clock offsets are found again."""

import json
import math
from dataclasses import replace

import pytest
import torch

from standing_person import Devices, acting
from wearcap.apps.live.clock_offset import LEAST_OFFSET_S, offset_by_turning
from wearcap.apps.live.guided import ARMS, RAISE, STAND, TURN, WALK
from wearcap.apps.live.setup import Seat, Setup, hand_seat, read_setup, write_setup
from wearcap.apps.live.setup_estimation import SetupEstimation
from wearcap.body.skeleton import skeleton_of_height, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis, exp
from wearcap.geometry.trajectory import Trajectory
from wearcap.sensors.samples import HeadSample, SuitPiece, WatchSample, WristSample

HEAD, HANDS = ("head",), ("head", "left_wrist", "right_wrist")
GUIDED = [("stand", 6.0), ("turn", 8.0), ("stand", 3.0), ("raise", 2.5), ("stand", 1.0), ("walk", 5.0), ("stand", 2.0)]
MOUNTS = (exp(torch.tensor([0.0, 0.0, 1.45])), exp(torch.tensor([0.1, 0.0, 1.7])))
"""R_wrist_watch of two watches as they are usually worn, left and right."""


def degrees(R_a, R_b):
    return math.degrees(rotation.geodesic(R_a, R_b).item())


def controllers():
    """T_wrist_device of two held controllers."""
    seats = [hand_seat(joint, "grip") for joint in HANDS[1:]]
    return tuple(Rigid(seat.R_joint_device, seat.t_joint_device) for seat in seats)


def watches(**changed):
    T_wrist_device = tuple(Rigid(R, torch.zeros(3)) for R in MOUNTS)
    return Devices(watches=True, T_wrist_device=T_wrist_device, yaw_rad=(2.0, -1.1), **changed)


# --- by itself -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("height_m", [1.55, 1.82, 1.98])
def test_height_of_someone_who_stands(height_m):
    first = SetupEstimation(HEAD)
    took_s = Devices().play(acting(height_m, [("stand", 5.0)]), first)
    assert took_s < 3.0
    assert first.found.skeleton.stature == pytest.approx(height_m, abs=0.01)
    assert first.found.floor_m == 0.0
    assert first.found.seats["head"].joint == "head"
    assert "above the floor" in " ".join(first.found.notes)


def test_height_is_not_taken_while_walking_but_from_the_head_at_last():
    first = SetupEstimation(HEAD)
    took_s = Devices().play(acting(1.7, [("walk", 12.0)]), first)
    assert 8.0 < took_s < 9.0
    assert first.found.skeleton.stature == pytest.approx(1.7, abs=0.03)
    assert "rough" in " ".join(first.found.notes)


def test_a_given_height_starts_at_once_and_believes_only_its_own_floor():
    first = SetupEstimation(HEAD, height_m=1.9)
    assert Devices().play(acting(1.9, [("walk", 5.0)]), first) < 1.0
    assert (first.found.skeleton.stature, first.found.floor_m) == (pytest.approx(1.9), 0.0)
    first = SetupEstimation(HEAD, height_m=1.9)
    Devices(floor_m=-0.4).play(acting(1.9, [("walk", 5.0)]), first)
    assert first.found.floor_m is None
    with pytest.raises(WearcapError, match="height of 19"):
        SetupEstimation(HEAD, height_m=19.0)


def test_without_a_floor_the_default_height_and_a_note():
    first = SetupEstimation(HEAD)
    took_s = Devices(floor_m=-1.6).play(acting(1.6, [("stand", 12.0)]), first)
    assert 8.0 < took_s < 9.0
    assert first.found.skeleton.stature == pytest.approx(xsens23().stature)
    assert first.found.floor_m is None
    assert "default" in " ".join(first.found.notes)


@pytest.mark.parametrize(("guided", "seconds"), [(False, 8.0), (True, 2.2)])
def test_who_sits_keeps_the_default_height_and_the_floor(guided, seconds):
    """A head that is still at 1.12 m: as that of somebody of 1.25 m who stands."""
    first, motion = SetupEstimation(HEAD, guided=guided), acting(1.75, [("stand", 12.0)])
    motion = replace(motion, t_world_root=motion.t_world_root - torch.tensor([0.0, 0.0, 0.45]))
    assert Devices().play(motion, first) == pytest.approx(seconds, abs=0.5)
    assert first.found.skeleton.stature == pytest.approx(xsens23().stature)
    assert first.found.floor_m == 0.0
    assert "seated: the height is not known" in " ".join(first.found.notes)


def test_a_child_who_walks_is_no_wearer_who_sits():
    first = SetupEstimation(HEAD)
    Devices().play(acting(1.3, [("stand", 3.0), ("walk", 12.0)]), first)
    assert first.found.skeleton.stature == pytest.approx(1.3, abs=0.03)


def test_a_floor_that_the_device_knows():
    first = SetupEstimation(HEAD)
    first.see("head", HeadSample(99.9, None, floor_height=2.5), 4.9)
    Devices(floor_m=2.5).play(acting(1.65, [("stand", 5.0)]), first)
    assert first.found.floor_m == 2.5
    assert first.found.skeleton.stature == pytest.approx(1.65, abs=0.01)


@pytest.mark.parametrize("names", [("left_wrist", "right_wrist"), ("B", "A"), ("A", "B"), ("left_wrist", "LHR-1")])
def test_controllers_become_wrists_of_the_right_side(names):
    first, devices = SetupEstimation(HANDS), Devices(names=names, T_wrist_device=controllers())
    motion = acting(1.8, [("stand", 5.0)])
    assert devices.play(motion, first) < 3.5
    for side, joint in enumerate(HANDS[1:]):
        seat = first.found.seats[names[side]]
        assert seat.joint == joint
        T_world_device = motion.joint(joint)[0] @ devices.T_wrist_device[side]
        wrist = T_world_device @ Rigid(seat.R_joint_device, seat.t_joint_device).inverse()
        torch.testing.assert_close(wrist.t, motion.joint(joint)[0].t, atol=1e-5, rtol=0)
        torch.testing.assert_close(wrist.R, motion.joint(joint)[0].R, atol=1e-5, rtol=0)


@pytest.mark.parametrize("names", [("left_wrist", "right_wrist"), ("watch-9", "watch-1")])
def test_watches_are_seated_roughly_by_hanging_arms(names):
    first, devices = SetupEstimation(HANDS, tracked=False), watches(names=names)
    assert devices.play(acting(1.75, [("stand", 6.0)]), first) < 4.0
    for side, joint in enumerate(HANDS[1:]):
        seat = first.found.seats[names[side]]
        assert seat.joint == joint
        assert degrees(seat.R_joint_device, MOUNTS[side]) < 16
        assert abs(math.remainder(seat.yaw_rad - devices.yaw_rad[side], 2 * math.pi)) < 0.3
    assert "rough" in " ".join(first.found.notes)


def test_a_device_that_is_missing_is_not_waited_for_forever():
    first = SetupEstimation(HANDS)
    took_s = Devices(names=("left_wrist", "")).play(acting(1.8, [("stand", 20.0)]), first)
    assert 15.0 < took_s < 16.0
    assert first.found.seats.keys() == {"head", "left_wrist", "right_wrist"}
    assert "Right wrist: no device was seen." in first.found.notes


def test_a_suit_brings_its_own_skeleton():
    first = SetupEstimation(("suit", "camera"))
    motion = acting(1.66, [("stand", 0.1)])
    first.see("suit", SuitPiece(motion), 0.0)
    assert first.found.skeleton is motion.skeleton
    assert not first.found.seats


# --- guided --------------------------------------------------------------------------------------------------------


def test_guided_head_is_levelled():
    """A headset that is tilted on the head, in a world whose floor is not known, with a given height."""
    tilt = about_axis("y", torch.tensor(math.radians(20.0)))
    devices = Devices(T_head_device=Rigid(tilt, torch.tensor([0.09, 0.0, 0.075])), floor_m=0.7)
    first = SetupEstimation(HEAD, height_m=1.8, guided=True)
    assert (first.step.name, first.step.progress) == (STAND, 0.0)
    devices.play(acting(1.8, GUIDED), first)
    assert degrees(first.found.seats["head"].R_joint_device, tilt) < 1.0
    assert first.found.floor_m == pytest.approx(0.7, abs=0.03)
    assert first.step is None


@pytest.mark.parametrize("names", [("left_wrist", "right_wrist"), ("watch-9", "watch-1"), ("watch-1", "watch-9")])
def test_guided_watches(names):
    first, devices = SetupEstimation(HANDS, tracked=False, guided=True), watches(names=names)
    took_s = devices.play(acting(1.75, GUIDED), first)
    assert took_s < 25.0
    assert first.found.skeleton.stature == pytest.approx(1.75, abs=0.01)
    for side, joint in enumerate(HANDS[1:]):
        seat = first.found.seats[names[side]]
        assert seat.joint == joint
        assert degrees(seat.R_joint_device, MOUNTS[side]) < 16
        assert abs(math.remainder(seat.yaw_rad - devices.yaw_rad[side], 2 * math.pi)) < 0.1
    assert "swing" in " ".join(first.found.notes)


def test_watches_whose_application_sends_a_second_at_once():
    first, devices = SetupEstimation(HANDS, tracked=False, guided=True), watches(batch_s=1.0)
    devices.play(acting(1.75, GUIDED), first)
    assert not [note for note in first.found.notes if "too long" in note]
    for side, joint in enumerate(HANDS[1:]):
        assert degrees(first.found.seats[joint].R_joint_device, MOUNTS[side]) < 16
        assert abs(math.remainder(first.found.seats[joint].yaw_rad - devices.yaw_rad[side], 2 * math.pi)) < 0.1


def test_guided_trackers_strapped_anyhow():
    """Trackers of unknown place that are no controllers: sides by where they hang, seats by the hanging arm."""
    turned = tuple(Rigid(exp(torch.tensor([0.2, 3.0, -0.4])), torch.zeros(3)) for _ in range(2))
    first = SetupEstimation(HANDS, guided=True)
    Devices(names=("T2", "T1"), T_wrist_device=turned).play(acting(1.7, GUIDED), first)
    for device, joint in (("T2", "left_wrist"), ("T1", "right_wrist")):
        seat = first.found.seats[device]
        assert seat.joint == joint
        assert degrees(seat.R_joint_device, turned[0].R) < 20


def test_steps_say_why_they_wait_and_can_be_skipped_and_done_again():
    first, devices = SetupEstimation(HANDS, tracked=False, guided=True), watches()
    devices.play(acting(1.75, [("walk", 4.0)]), first)
    assert first.step.name == STAND
    assert str(first.step) == "Stand still and look straight ahead. Head still moves."
    first.skip()
    assert first.step.name == ARMS
    devices.play(acting(1.75, [("stand", 1.0)]), first, 104.0)
    assert first.step.progress > 0.1
    first.redo()
    assert (first.step.name, first.step.progress) == (ARMS, 0.0)
    for _ in range(9):
        first.skip()
    devices.play(acting(1.75, [("stand", 1.0)]), first, 106.0)
    assert first.step is None
    assert sum("skipped" in note for note in first.found.notes) >= 2
    first.skip()
    first.redo()


def test_a_step_that_takes_too_long_is_left():
    first = SetupEstimation(HEAD, guided=True)
    took_s = Devices().play(acting(1.75, [("walk", 30.0)]), first)
    assert 25.0 < took_s < 26.0
    assert "too long" in " ".join(first.found.notes)


def test_all_steps_in_their_order():
    """Watches whose x axis shows no side: the raised left hand decides."""
    across = Rigid(exp(torch.tensor([0.0, 0.0, 0.1])), torch.zeros(3))
    first = SetupEstimation(HANDS, tracked=False, guided=True)
    devices = Devices(watches=True, names=("a", "b"), T_wrist_device=(across, across))
    steps, motion = [], acting(1.75, GUIDED)
    original = first.look

    def look(now_s):
        original(now_s)
        if first.step is not None and first.step.name not in steps:
            steps.append(first.step.name)

    first.look = look
    devices.play(motion, first)
    assert steps == [STAND, ARMS, TURN, RAISE, WALK]
    assert {name: seat.joint for name, seat in first.found.seats.items()} == {
        "head": "head",
        "a": "left_wrist",
        "b": "right_wrist",
    }


# --- last time, files ----------------------------------------------------------------------------------------------


def a_setup():
    seat = Seat("left_wrist", exp(torch.tensor([0.3, -0.2, 1.0])), torch.tensor([0.01, 0.0, -0.02]), 1.25)
    return Setup(skeleton_of_height(1.63), {"watch": seat}, -0.25, ("Height: as given.", "Ünïcode"))


def test_a_setup_comes_back_from_its_file(tmp_path):
    setup = a_setup()
    write_setup(setup, tmp_path / "setup.json")
    found = read_setup(tmp_path / "setup.json")
    assert found.skeleton == setup.skeleton
    assert (found.floor_m, found.notes) == (setup.floor_m, setup.notes)
    seat, was = found.seats["watch"], setup.seats["watch"]
    assert (seat.joint, seat.yaw_rad) == (was.joint, was.yaw_rad)
    torch.testing.assert_close(seat.R_joint_device, was.R_joint_device)
    torch.testing.assert_close(seat.t_joint_device, was.t_joint_device)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("wearcap_setup",), 2),
        (("floor_m",), "low"),
        (("floor_m",), float("nan")),
        (("seats",), []),
        (("seats", "watch", "joint"), "tail"),
        (("seats", "watch", "R_joint_device_wxyz"), [0, 0, 0, 0]),
        (("seats", "watch", "R_joint_device_wxyz"), [1, 0, 0]),
        (("seats", "watch", "t_joint_device"), [0, 0, 99]),
        (("seats", "watch", "yaw_rad"), True),
        (("skeleton", "parents", 1), 5),
        (("skeleton", "t_parent_joint", 3, 1), None),
        (("skeleton", "joint_names", 3), "pelvis"),
        (("skeleton", "sites", "crown", 0), "nowhere"),
        (("skeleton", "t_parent_joint"), []),
        (("notes",), [3]),
    ],
)
def test_a_damaged_setup_is_refused_in_one_line(tmp_path, place, value):
    path = tmp_path / "setup.json"
    write_setup(a_setup(), path)
    content = json.loads(path.read_text())
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path.write_text(json.dumps(content))
    with pytest.raises(WearcapError, match=r"setup\.json") as raised:
        read_setup(path)
    assert "\n" not in str(raised.value)


def test_the_setup_of_last_time_spares_the_waiting():
    before = SetupEstimation(HANDS)
    devices = Devices(names=("X", "Y"), T_wrist_device=controllers())
    devices.play(acting(1.83, [("stand", 5.0)]), before)
    again = SetupEstimation(HANDS, setup=before.found)
    assert devices.play(acting(1.83, [("walk", 5.0)]), again) < 1.0
    assert again.found.skeleton == before.found.skeleton
    assert {name: seat.joint for name, seat in again.found.seats.items()} == {
        "X": "left_wrist",
        "Y": "right_wrist",
        "head": "head",
    }
    assert "of last time" in " ".join(again.found.notes)


# --- hostile -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("tracked", [False, True])
def test_nothing_that_devices_send_raises(guided, tracked):
    random = torch.Generator().manual_seed(0)
    first = SetupEstimation(HANDS, tracked=tracked, guided=guided)
    bad = [float("nan"), float("inf"), -1e30, 1e9, None, "late", 3.0]
    for number in range(1500):
        pick = int(torch.randint(0, 12, (1,), generator=random))
        time_s = 10 + number / 60 if pick < 8 else bad[number % len(bad)]
        R = exp(3 * torch.randn(3, generator=random)) if pick != 1 else torch.full((3, 3), torch.nan)
        t = 3 * torch.randn(3, generator=random) if pick != 2 else torch.tensor([torch.inf, 0, 0])
        pose = [Rigid(R, t), None, "pose", Rigid(R[None], t[None])][0 if pick > 4 else pick % 4]
        joint = ["left_wrist", "right_wrist", f"serial {number}", ""][number % 4]
        samples = (
            HeadSample(time_s, pose, floor_height=bad[number % len(bad)]),
            WristSample(joint, time_s, pose),
            WatchSample(time_s, R, t, joint),
            None,
            b"bytes",
        )
        for sample in samples:
            first.see("head" if isinstance(sample, HeadSample) else joint, sample, number / 60)
        if guided and number % 300 == 0:  # each step is left once
            first.skip()
            first.redo()
    assert len(first._seen) <= 32
    assert first.found is not None


def test_a_head_that_is_lost_and_a_clock_that_is_set_anew():
    first, devices = SetupEstimation(HEAD), Devices()
    devices.play(acting(1.7, [("stand", 1.0)]), first)
    for number in range(60):
        first.see("head", HeadSample(101 + number / 60), 6 + number / 60)
    assert first.found is None
    devices.play(acting(1.7, [("stand", 5.0)]), first, begin_s=3.0)
    assert first.found.skeleton.stature == pytest.approx(1.7, abs=0.01)


# --- clocks --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset_s", [-37.123, -0.4, 0.013, 5.0])
def test_turning_on_the_spot_gives_the_offset_of_head_and_watch(offset_s):
    motion = acting(1.75, [("stand", 2.0), ("turn", 8.0), ("walk", 4.0), ("stand", 2.0)])
    head, wrist = motion.joint("head"), motion.joint("left_wrist")
    jitter = exp(math.radians(0.3) * torch.randn(len(motion), 3, generator=torch.Generator().manual_seed(1)))
    R_ref_watch = about_axis("z", torch.tensor(1.9)) @ wrist.R @ jitter @ MOUNTS[0]
    of_head = Trajectory(motion.timestamps, head.R, head.t)
    of_watch = Trajectory(motion.timestamps[60:] - offset_s, R_ref_watch[60:], wrist.t[60:])
    assert offset_by_turning(of_head, of_watch, 60.0) == pytest.approx(offset_s, abs=0.010)


def test_who_stands_gives_no_offset():
    motion = acting(1.75, [("stand", 5.0)])
    head = Trajectory(motion.timestamps, motion.joint("head").R, motion.joint("head").t)
    with pytest.raises(WearcapError, match="hardly turns"):
        offset_by_turning(head, head)


GUIDED_WALK = [("stand", 6.0), ("turn", 8.0), ("stand", 4.0), ("walk", 9.0), ("stand", 2.0)]


@pytest.mark.parametrize("batch_s", [0.0, 1.0])
def test_watches_that_come_late_or_early_are_aligned_by_the_turn(batch_s):
    """The head leads by a tenth of a second, as people's do. The walk that follows is seen at its own time, too."""
    first = SetupEstimation(HANDS, tracked=False, guided=True)
    devices = watches(offset_s=(-1.7, 0.6), batch_s=batch_s)
    took_s = devices.play(acting(1.75, GUIDED_WALK, head_leads_s=0.1), first)
    assert took_s < 26.0
    for side, joint in enumerate(HANDS[1:]):
        assert devices.aligned[joint].offset_s == pytest.approx(devices.offset_s[side] - 0.1, abs=0.02)
        assert abs(math.remainder(first.found.seats[joint].yaw_rad - devices.yaw_rad[side], 2 * math.pi)) < 0.1
    assert "come 1.8" in devices.aligned["left_wrist"].note
    assert " late " in devices.aligned["left_wrist"].note
    assert " early " in devices.aligned["right_wrist"].note
    assert sum("swing" in note for note in first.found.notes) == 2
    assert not [note for note in first.found.notes if "clock" in note]


@pytest.mark.parametrize("head_leads_s", [0.0, 0.06, 0.16])
def test_a_head_that_turns_before_the_body_does_not_make_a_good_clock_worse(head_leads_s):
    first, devices = SetupEstimation(HANDS, tracked=False, guided=True), watches()
    assert devices.play(acting(1.75, GUIDED_WALK, head_leads_s=head_leads_s), first) < 25.0
    assert [each.offset_s for each in devices.aligned.values()] == [0.0, 0.0]
    assert all(f"no offset of its clock above {LEAST_OFFSET_S}" in each.note for each in devices.aligned.values())


def test_who_does_not_turn_is_told_that_the_clocks_are_as_before():
    first, devices = SetupEstimation(HANDS, tracked=False, guided=True), watches(offset_s=(-1.7, 0.6))
    took_s = devices.play(acting(1.75, [("stand", 32.0), ("walk", 6.0)]), first)
    assert 25.0 < took_s < 36.0
    for joint in HANDS[1:]:
        assert devices.aligned[joint].offset_s == 0.0
        assert "hardly turns" in devices.aligned[joint].note


def test_a_head_that_turns_alone_is_asked_once_more_and_gives_nothing():
    motion = acting(1.75, [("stand", 6.0), ("turn", 8.0), ("stand", 20.0)])
    still = acting(1.75, [("stand", 34.0)])
    turned = replace(still, R_parent_joint=still.R_parent_joint.clone())
    neck = still.skeleton.index("head")
    turned.R_parent_joint[:, neck] = still.R_parent_joint[:, 0].mT @ motion.R_parent_joint[:, 0]
    first, devices = SetupEstimation(HANDS, tracked=False, guided=True), watches()
    devices.play(turned, first, until_s=17.0)
    assert str(first.step).endswith("wrist has not turned as far.")
    devices.play(turned, first, begin_s=117.0)
    assert all("hardly turns" in each.note for each in devices.aligned.values())
