"""TotalCapture in its archives' layout: body and sensors agree, whatever tools wrote, and foreign files are refused."""

import contextlib

import pytest
import torch
from hypothesis import given
from totalcapture_files import vicon, write_totalcapture

from data_prep.totalcapture import (
    PARENTS,
    SENSORS,
    is_totalcapture,
    read_reference,
    read_sensors,
    read_totalcapture,
    read_vicon,
    totalcapture_files,
)
from hostile import fuzz, mutated
from wearcap.apps.doctor import examine
from wearcap.cli.main import run_verb
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording.store import RecordingStore
from wearcap.sensors.watches import watches_at

FRAMES = 150


def read(root):
    (files,) = totalcapture_files(root)
    return read_totalcapture(files)


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_the_body_stands_up_where_vicon_saw_it(tmp_path, order):
    write_totalcapture(tmp_path, order=order)
    motion, (_, wanted) = read(tmp_path).motion, vicon(FRAMES)
    found = motion.T_world_joint.t
    torch.testing.assert_close(found[..., 2], wanted[..., 1].float(), atol=1e-4, rtol=0)
    torch.testing.assert_close(found[..., 1], -wanted[..., 2].float(), atol=1e-4, rtol=0)
    assert motion.fps == pytest.approx(60.0)
    left, right = motion.skeleton.index("LeftUpLeg"), motion.skeleton.index("RightUpLeg")
    assert (motion.skeleton.rest_joints[left] - motion.skeleton.rest_joints[right])[1] > 0.17, "the rest pose faces x"


def test_the_sensors_begin_earlier_and_turn_with_the_body(tmp_path):
    write_totalcapture(tmp_path)
    found = read(tmp_path)
    assert set(found.imu) == set(SENSORS.values())
    head = found.imu["head"]
    assert len(head.timestamps) == FRAMES, "the ends belong together"
    body = found.motion.T_world_joint.R[:, found.motion.skeleton.index("Head")]
    assert head.R_world_imu is not None
    mount = body.mT @ head.R_world_imu
    assert rotation.geodesic(mount, mount[:1].expand_as(mount)).max() < 1e-3
    assert head.acc_world is not None
    assert head.acc_world.norm(dim=-1).max() < 3.0, "gravity is taken off"


def test_a_data_set_is_prepared_by_subject_and_watches_can_be_worn(tmp_path):
    write_totalcapture(tmp_path / "in")
    write_totalcapture(tmp_path / "in", "s5", "acting3")
    out = tmp_path / "out"
    assert run_verb("prepare", ["totalcapture", f"source={tmp_path / 'in'}", "jobs=1", f"output={out}"]) == 0
    store = RecordingStore.open(out)
    assert (store.names("train"), store.names("test")) == (["s1_walking2"], ["s5_acting3"])
    recording = store.load("s5_acting3")
    assert recording.motion is not None
    assert recording.activity == "acting"
    assert recording.motion.skeleton.name == "xsens23"
    times = recording.motion.timestamps[::2].contiguous()
    R, acc = watches_at(recording.imu, times, "s5")
    for number, joint in enumerate(("left_wrist", "right_wrist")):
        true = recording.motion.joint(joint).R[::2]
        assert rotation.geodesic(R[:, number].float(), true).rad2deg().median() < 5
    assert acc.norm(dim=-1).mean() < 3.0


def test_a_sensor_that_does_not_turn_with_the_body_is_refused(tmp_path, capsys):
    write_totalcapture(tmp_path, frames=240)
    path = next(tmp_path.rglob("*.sensors"))
    lines = path.read_text().splitlines()
    first = next(line for line in lines if line.startswith("L_LowArm"))
    path.write_text("\n".join(first if line.startswith("L_LowArm") else line for line in lines))
    with pytest.raises(SystemExit):
        run_verb("prepare", ["totalcapture", f"source={tmp_path}", "jobs=1", f"output={tmp_path / 'out'}"])
    assert "the sensor of left_wrist is" in "".join(capsys.readouterr())


def test_a_sequence_in_one_folder_is_examined(tmp_path):
    write_totalcapture(tmp_path)
    folder = tmp_path / "s1" / "walking2"
    folder.mkdir(parents=True)
    for path in [*tmp_path.rglob("*.txt"), *tmp_path.rglob("*.sensors")]:
        path.rename(folder / path.name)
    assert is_totalcapture(folder)
    assert not is_totalcapture(tmp_path)
    assert examine(folder)


@pytest.mark.parametrize(
    ("kind", "old", "new", "what"),
    [
        ("*.sensors", "13\t157", "13\t158", "157 frames"),
        ("*.sensors", "13\t157", "99\t157", "numbers of sensors"),
        ("*.sensors", "\n5\n", "\n6\n", "number of frame 5"),
        ("*.sensors", "Pelvis\t", "Pelvis\t1\t", "15 fields"),
        ("*.sensors", "Pelvis\t", "Hips\t", "no sensor Pelvis"),
        ("*ref.txt", "Head ", "Head 9", "finite"),
        ("*ref.txt", "13\n", "12\n", "13 sensors"),
        ("*pos.txt", "Neck", "Nose", "joints"),
        ("*pos.txt", "RightHand\tLeftShoulder", "LeftShoulder\tRightHand", "axes of their parents"),
        ("*ori.txt", " ", " 0 ", "numbers"),
    ],
)
def test_foreign_contents_are_refused(tmp_path, kind, old, new, what):
    write_totalcapture(tmp_path)
    path = next(tmp_path.rglob(kind))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(WearcapError, match=what):
        read(tmp_path)


def test_someone_who_stands_still_says_nothing_about_the_order(tmp_path):
    write_totalcapture(tmp_path, frames=1)
    with pytest.raises(WearcapError, match="two or more"):
        read(tmp_path)


SENSORS_TEXT = "1\t2\n1\nHead" + "\t1" * 13 + "\n2\nHead" + "\t0.5" * 13 + "\n"
VICON_TEXT = "\t".join(PARENTS) + "\n" + "\t".join(["1 2 3"] * len(PARENTS)) + "\n"


@fuzz
@given(text=mutated(SENSORS_TEXT) | mutated(VICON_TEXT) | mutated("1\nHead 0 0 0 1\n"))
def test_damaged_files_are_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "fuzzed.txt"
    path.write_text(text, encoding="utf-8")
    for reader in (read_sensors, read_reference, lambda file: read_vicon(file, 3)):
        with contextlib.suppress(WearcapError):
            reader(path)
