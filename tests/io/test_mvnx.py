"""MVNX files, written here as MVN Analyze exports them: values, bones, contacts, sensors; hostile files; fuzz."""

import gzip
import re
import warnings

import pytest
import torch
from hypothesis import given

from hostile import fuzz, mutated
from mvnx_files import CONTACTS, IDENTITY, mvnx, sample, sensors
from wearcap.errors import WearcapError
from wearcap.io.formats.mvnx import read_mvnx


def save(tmp_path, text: str):
    (tmp_path / "t.mvnx").write_bytes(text.encode("utf-8", "replace"))
    return tmp_path / "t.mvnx"


@pytest.mark.parametrize("rest", ["identity", "tpose", ""])
def test_pose_bones_contacts_and_sensors_come_back(tmp_path, rest):
    motion = sample()
    recording = read_mvnx(save(tmp_path, mvnx(motion, rest)))
    back = recording.motion
    assert back.skeleton.name == "xsens23"
    assert back.fps == pytest.approx(240)
    torch.testing.assert_close(back.skeleton.t_parent_joint, motion.skeleton.t_parent_joint, atol=2e-6, rtol=0)
    torch.testing.assert_close(back.R_parent_joint, motion.R_parent_joint, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.T_world_joint.t, motion.T_world_joint.t, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.contact_prob, motion.contact_prob)
    assert back.skeleton.sites["left_heel"].t_joint_site == pytest.approx((-0.06, 0, -0.05))
    assert back.skeleton.sites["crown"].t_joint_site == pytest.approx((0, 0, 0.2))
    acc, R_sensor = sensors(len(motion))
    assert set(recording.imu) == {"pelvis", "t8", "head", "left_elbow", "right_elbow", "left_knee", "right_knee"} - {
        "right_knee"
    }
    torch.testing.assert_close(recording.imu["left_elbow"].acc_world, acc[:, 3], atol=1e-6, rtol=0)
    torch.testing.assert_close(recording.imu["left_elbow"].R_world_imu, R_sensor[:, 3], atol=1e-6, rtol=0)


def test_contacts_are_sorted_by_their_labels(tmp_path):
    motion = sample()
    turned = read_mvnx(save(tmp_path, mvnx(motion, contacts=CONTACTS[::-1]))).motion
    torch.testing.assert_close(turned.contact_prob, motion.contact_prob)
    unnamed = read_mvnx(save(tmp_path, mvnx(motion, contacts=[]))).motion
    torch.testing.assert_close(unnamed.contact_prob, motion.contact_prob)


def test_dropped_frames_and_packed_files(tmp_path):
    text = mvnx(sample()).replace('time="21" index="5"', 'time="38" index="9"')
    (tmp_path / "t.mvnx.gz").write_bytes(gzip.compress(text.encode()))
    recording = read_mvnx(tmp_path / "t.mvnx.gz")
    assert recording.name == "t"
    assert recording.motion.timestamps[-1].item() == pytest.approx(9 / 240)
    (tmp_path / "t.mvnx.gz").write_bytes(gzip.compress(text.encode())[:2000])
    with pytest.raises(WearcapError, match="not a complete"):
        read_mvnx(tmp_path / "t.mvnx.gz")


@pytest.mark.parametrize(
    ("times", "note", "expected"),
    [
        (lambda k: 1000 * k / 240, "span 3.317 s, but its frame times 0.829 s.*240 Hz", lambda k: k / 240),
        (lambda k: 1000 * (k + (k >= 50) * 30) / 60, "3.817 s: the times", lambda k: (k + (k >= 50) * 30) / 60),
        (lambda k: 1000 * k / 60, "", lambda k: k / 60),
        (lambda k: 0, "span 0 s, are no rising", lambda k: k / 60),
        (lambda k: 20 * (k % 7), "no rising milliseconds", lambda k: k / 60),
        (lambda k: 1e6 * k / 60, "span 3317 s, are no rising milliseconds", lambda k: k / 60),
    ],
    ids=["another rate", "a gap", "as stated", "no times", "times that fall", "microseconds"],
)
def test_frame_times_win_over_the_stated_rate(tmp_path, times, note, expected):
    text = mvnx(sample(200)).replace('frameRate="240"', 'frameRate="60"')
    text = re.sub(r'time="\d+" index="(\d+)"', lambda m: f'time="{times(int(m[1])):.0f}" index="{m[1]}"', text)
    recording = read_mvnx(save(tmp_path, text))
    assert re.search(note, recording.note)
    assert bool(recording.note) == bool(note)
    expected = torch.tensor([expected(k) for k in range(200)], dtype=torch.float64)
    torch.testing.assert_close(recording.motion.timestamps, expected, atol=6e-4, rtol=0)


@pytest.mark.real
def test_a_real_take_with_a_wrong_rate(real_data):
    recording = read_mvnx(real_data / "field" / "M_rate_contradicts_times.mvnx")
    times = torch.arange(40, dtype=torch.float64) / 60
    torch.testing.assert_close(recording.motion.timestamps, times)
    torch.testing.assert_close(recording.imu["head"].timestamps, times)
    assert "stated 240 Hz" in recording.note


def test_doubtful_files_warn(tmp_path):
    text = mvnx(sample())
    position = text.index("<position>", text.index('index="3"')) + len("<position>")
    stretched = text[:position] + "9 " + text[text.index(" ", position) + 1 :]
    with pytest.warns(UserWarning, match="away from where"):
        read_mvnx(save(tmp_path, stretched))


TEXT = mvnx(sample(2))
BOMB = """<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">
<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><mvnx>&c;</mvnx>"""
FILE_READ = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><mvnx>&a;</mvnx>'
FAULTS = {
    "empty": ("", "broken XML"),
    "garbage": ("\x01\x02", "broken XML"),
    "truncated": (TEXT[: len(TEXT) * 2 // 3], "broken XML.*line"),
    "entity bomb": (BOMB, "entities"),
    "outside entity": (FILE_READ, "entities"),
    "other xml": ("<html></html>", "segments"),
    "no frames": (TEXT.replace('type="normal"', 'type="other"'), "no frames"),
    "missing segment": (TEXT.replace('label="LeftFoot" id', 'label="Tail" id'), "leftfoot"),
    "wrong count": (TEXT.replace("<position>", "<position>1 ", 2), "identity frame: position with 70"),
    "nan": (re.sub(r"(<sensorFreeAcceleration>)\S+", r"\1nan", TEXT), "normal frame 0: .nan. is no finite"),
    "nan at rest": (TEXT.replace(IDENTITY, "nan 0 0 0 ", 1), "identity frame: .nan. is no finite"),
    "missing field": (re.sub(r"(?s)(.*)<footContacts>.*?</footContacts>", r"\1", TEXT), "frame 1: a frame with"),
    "no quaternion": (
        TEXT.replace("<sensorOrientation>", "<sensorOrientation>7").replace("7-", "-7"),
        "unit quaternion",
    ),
    "rate 0": (TEXT.replace('frameRate="240"', 'frameRate="0"'), "frame rate"),
    "rate text": (TEXT.replace('frameRate="240"', 'frameRate="fast"'), "cannot be understood"),
    "no rate": (TEXT.replace('frameRate="240"', ""), "cannot be understood"),
    "frames backwards": (TEXT.replace('index="1" tc', 'index="0" tc'), "repeat or fall"),
    "huge count": (
        TEXT.replace('segmentCount="23"', 'segmentCount="99999999999"').replace('index="1" tc', 'index="x" tc'),
        "normal frame x",
    ),
    "segment without label": (TEXT.replace('<segment label="L5"', "<segment"), "cannot be understood"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_hostile_mvnx_is_named(tmp_path, fault):
    text, message = FAULTS[fault]
    with pytest.raises(WearcapError, match=message) as caught:
        read_mvnx(save(tmp_path, text))
    assert "t.mvnx" in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(WearcapError, match="no such file"):
        read_mvnx(tmp_path / "none.mvnx")


@fuzz
@given(text=mutated(TEXT))
def test_fuzz_gives_a_recording_or_one_clear_error(tmp_path, text):
    try:
        with warnings.catch_warnings(action="ignore"):
            recording = read_mvnx(save(tmp_path, text))
    except WearcapError:
        return
    assert recording.motion.R_parent_joint.isfinite().all()
