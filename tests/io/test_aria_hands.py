"""Hands of Aria's MPS as wrists: made files with known poses, and a real sample."""

import gzip

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_aria_mps import rows as poses
from test_aria_mps import write

from wearcap.cli.main import run_verb
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.devices.aria_hands import read_hands
from wearcap.io.devices.aria_mps import mps_files, nominal_T_aria_cpf, read_mps
from wearcap.io.formats.csv_table import read_columns, read_header
from wearcap.prepare.logs import TrajectorySettings, read_path
from wearcap.reading.kits import load_mps
from wearcap.recording import RecordingStore

TIMES = 10.02 + 0.0313 * np.arange(14)
"""Times (s) of hands between those of poses, which end at 10.49 s."""
ON_HAND = {"wrist": (0, 0, 0), "palm": (0, 0.082, -0.02)}
LANDMARKS = {5: (0, 0, 0), 20: (0, 0.082, -0.02), 8: (0.03, 0.09, 0), 17: (-0.04, 0.08, 0)}
"""Points of left hands in the axes of wearcap's wrist (x to the thumb's side, y to the fingers, z out of the back)."""
AT_REST = Rotation.from_quat([0.5, 0.5, -0.5, 0.5])
SIDES = {"left": 1, "right": -1}


def of_device(time):
    """(rotation, place) of a device that turns at 0.7 rad/s while it moves straight ahead."""
    turn = Rotation.from_rotvec(np.outer(np.atleast_1d(time) - 10, [0, 0, 0.7]))
    return turn * AT_REST, np.outer(np.atleast_1d(time) - 10, [1.0, 0.2, 0]) + np.array([0, 0, 1.6])


def of_wrist(side):
    """(rotations, places in the world) of wrists at `TIMES`."""
    rng = np.random.default_rng(len(side))
    return Rotation.random(len(TIMES), rng), rng.normal([0.3, 0, 1.2], 0.3, (len(TIMES), 3))


def hand_rows(normals=True, landmarks=False, **changes):
    """CSV rows at `TIMES`, by scipy; `changes` replace columns by a function of the row."""
    R_device, t_device = of_device(TIMES)
    columns = {"tracking_timestamp_us": np.round(TIMES * 1e6).astype(int)}
    for side, left in SIDES.items():
        R, t = of_wrist(side)
        columns[f"{side}_tracking_confidence"] = np.full(len(TIMES), 0.97)
        parts = {f"landmark_{k}": at for k, at in LANDMARKS.items()} if landmarks else ON_HAND
        values = {f"t{{}}_{side}_{k}": R.apply(np.multiply(at, [1, left, 1])) + t - t_device for k, at in parts.items()}
        if normals:
            values[f"n{{}}_{side}_palm"] = R.apply([0.1, 0.1, -0.99])
            values[f"n{{}}_{side}_wrist"] = R.apply([0, 0, -1])
        for name, vectors in values.items():
            turned = R_device.inv().apply(vectors)
            columns |= {f"{name.format(axis)}_device": turned[:, k] for k, axis in enumerate("xyz")}
    table = [{name: values[k].item() for name, values in columns.items()} for k in range(len(TIMES))]
    return [row | {name: change(k, row[name]) for name, change in changes.items()} for k, row in enumerate(table)]


def folder_of(path, hands, name="hand_tracking/wrist_and_palm_poses.csv", opener=open):
    """An MPS folder with a moving device's path and a file of hands."""
    quat = {
        f"q{a}_world_device": lambda k, a=a: of_device(10 + 0.01 * k)[0].as_quat()[0, "xyzw".index(a)] for a in "xyzw"
    }
    place = {f"t{a}_world_device": lambda k, a=a: of_device(10 + 0.01 * k)[1][0, "xyz".index(a)] for a in "xyz"}
    (path / "slam").mkdir(exist_ok=True)
    write(path / "slam" / "closed_loop_trajectory.csv", poses(50, **quat, **place))
    (path / name).parent.mkdir(parents=True, exist_ok=True)
    write(path / name, hands, opener)
    return path


def assert_poses(found: Trajectory, side, kept):
    R, t = of_wrist(side)
    assert found.timestamps.numpy() == pytest.approx(TIMES[kept], abs=1e-6)
    assert found.t_world_body.numpy() == pytest.approx(t[kept], abs=2e-5)
    apart = (Rotation.from_matrix(found.R_world_body.numpy()).inv() * R[kept]).magnitude()
    assert apart.max() < 1e-3


@pytest.mark.parametrize("kind", [{}, {"landmarks": True}, {"landmarks": True, "normals": False}])
def test_wrists_of_both_hands_stand_in_the_world(tmp_path, kind):
    """Each side is left out where it is not tracked or unsure, by itself; the device moves and turns between the rows."""
    score = {
        "left_tracking_confidence": lambda k, value: -1 if 4 <= k < 8 else 0.3 if k == 9 else value,
        "right_tracking_confidence": lambda k, value: 0.5 if k == 2 else -1 if k == 0 else value,
    }
    name = "hand_tracking_results" if kind else "wrist_and_palm_poses"
    hands = hand_rows(**kind, **score)
    recording = read_mps(folder_of(tmp_path, hands, f"hand_tracking/{name}.csv"))
    assert_poses(recording.tracked["left_wrist"], "left", [0, 1, 2, 3, 8, 10, 11, 12, 13])
    assert_poses(recording.tracked["right_wrist"], "right", list(range(1, 14)))
    assert recording.note == ""


@pytest.mark.parametrize(
    ("name", "opener"),
    [
        ("wrist_and_palm_poses_v2.csv", open),
        ("hand_tracking/wrist_and_palm_poses.csv.gz", gzip.open),
        ("mps/hand_tracking/wrist_and_palm_poses.csv", open),
    ],
)
def test_files_are_found_where_mps_puts_them(tmp_path, name, opener):
    folder = folder_of(tmp_path, hand_rows(), name, opener)
    assert set(read_mps(folder).tracked) == {"left_wrist", "right_wrist"}
    assert folder / name in mps_files(folder)


def test_rows_outside_the_path_and_hands_never_seen_are_left_out(tmp_path):
    """The first row is before the path, the last two after it; the right hand is never tracked."""
    shifted = {
        "tracking_timestamp_us": lambda k, value: value - 10**6 if k == 0 else value + 10**6 if k > 11 else value,
        "right_tracking_confidence": lambda k, value: -1,
    }
    tracked = read_mps(folder_of(tmp_path, hand_rows(**shifted))).tracked
    assert list(tracked) == ["left_wrist"]
    assert_poses(tracked["left_wrist"], "left", list(range(1, 12)))
    late = {"tracking_timestamp_us": lambda k, value: value + 10**7}
    recording = read_mps(folder_of(tmp_path, hand_rows(**late)))
    assert recording.tracked == {}
    assert recording.note == "wrist_and_palm_poses.csv tracks no hand at a time of the head's path"


def test_older_files_without_normals_need_landmarks(tmp_path):
    folder = folder_of(tmp_path, hand_rows(normals=False))
    recording = read_mps(folder)
    assert recording.tracked == {}
    assert recording.note == "wrist_and_palm_poses.csv has no normals or landmarks: hands are left out"
    assert ("hands", recording.note) in {(found.check, found.evidence) for found in load_mps(folder).findings}
    assert recording.note in read_path(folder, "wearer", {}, TrajectorySettings()).note
    write(tmp_path / "hand_tracking" / "hand_tracking_results.csv", hand_rows(normals=False, landmarks=True))
    recording = read_mps(folder)
    assert_poses(recording.tracked["right_wrist"], "right", list(range(14)))
    assert recording.note == ""
    assert len(mps_files(folder)) == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tx_left_wrist_device": lambda k, value: "nan" if k == 6 else value}, "row 7: left hand is NaN"),
        ({"right_tracking_confidence": lambda k, value: "nan"}, "row 1: right_tracking_confidence is NaN"),
        ({"tracking_timestamp_us": lambda k, value: -value}, "timestamps that rise"),
        ({f"n{a}_right_wrist_device": lambda k, value: value if k < 5 else 0 for a in "xyz"}, "row 6: the right palm"),
    ],
)
def test_defects_are_named(tmp_path, changes, message):
    folder = folder_of(tmp_path, hand_rows(**changes))
    with pytest.raises(WearcapError, match=message) as error:
        read_mps(folder)
    assert "wrist_and_palm_poses.csv" in str(error.value)


def test_only_rows_of_tracked_hands_must_hold_numbers(tmp_path):
    changes = {
        "left_tracking_confidence": lambda k, value: -1 if k == 6 else value,
        "tx_left_wrist_device": lambda k, value: "nan" if k == 6 else value,
    }
    tracked = read_mps(folder_of(tmp_path, hand_rows(**changes))).tracked
    assert_poses(tracked["left_wrist"], "left", [k for k in range(14) if k != 6])


def test_a_missing_column_is_named(tmp_path):
    hands = [{name: value for name, value in row.items() if name != "ty_right_palm_device"} for row in hand_rows()]
    with pytest.raises(WearcapError, match="no column 'ty_right_palm_device'"):
        read_mps(folder_of(tmp_path, hands))


def test_hands_that_come_and_go_are_prepared_and_found_sound(tmp_path, capsys):
    """The data set keeps what the reader gives, gaps and all; doctor compares it with the head."""
    (source := tmp_path / "wearer").mkdir()
    gap = {"left_tracking_confidence": lambda k, value: -1 if 3 <= k < 11 else value}
    folder_of(source, hand_rows(**gap))
    assert run_verb("prepare", ["aria", f"source={source}", f"output={tmp_path}/out", "jobs=1"]) == 0
    stored, read = RecordingStore.open(tmp_path / "out").load("wearer").tracked, read_mps(source).tracked
    assert [len(track) for track in stored.values()] == [6, 14]
    for joint, track in stored.items():
        assert torch.equal(track.timestamps, read[joint].timestamps)
        assert torch.equal(track.R_world_body, read[joint].R_world_body)
        assert torch.equal(track.t_world_body, read[joint].t_world_body)
    for place in (source, tmp_path / "out" / "wearer"):
        assert run_verb("doctor", [str(place)]) in (0, None)
        found = capsys.readouterr().out
        assert "left_wrist: reach" in found
        assert "right_wrist: reach" in found


def real_hands(file):
    """(wrists in the device's axes, the file's columns): its times lie outside the sample's path, so one that rests is made."""
    table = read_columns(file, read_header(file))
    times = torch.from_numpy(table["tracking_timestamp_us"][[0, -1]] * 1e-6)
    still = Trajectory(times, torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3))
    wrists, note = read_hands([file], still)
    assert note == ""
    return wrists, table


@pytest.mark.real
@pytest.mark.parametrize(("side", "left"), SIDES.items())
def test_real_hands_have_fingers_along_y_and_curl_them_palmward(real_data, side, left):
    """Also MPS' own wrist frame, which this reader does not use, agrees: its z, x, y axes are x, y, z here."""
    wrists, table = real_hands(real_data / "aria_mps/hand_tracking/hand_tracking_results_v2.csv")
    wrist, kept = wrists[f"{side}_wrist"], table[f"{side}_tracking_confidence"] > 0
    places = [[table[f"t{a}_{side}_landmark_{k}_device"][kept] for a in "xyz"] for k in range(21)]
    in_wrist = torch.tensor(np.array(places).transpose(2, 0, 1)).float() - wrist.t_world_body[:, None]
    in_wrist = in_wrist @ wrist.R_world_body
    assert len(wrist) == 3
    distance = (wrist.t_world_body - nominal_T_aria_cpf().t).norm(dim=-1)
    assert 0.2 < distance.min() < distance.max() < 0.9
    assert 0.04 < in_wrist[:, 20].norm(dim=-1).min() < in_wrist[:, 20].norm(dim=-1).max() < 0.12
    along = in_wrist[:, 11] / in_wrist[:, 11].norm(dim=-1, keepdim=True)
    assert (left * along[:, 1]).min() > np.cos(np.radians(8)), "the middle finger's knuckle lies along the hand"
    assert in_wrist[:, 6, 0].min() > 0.03, "the thumb is at the side of x"
    assert in_wrist[:, 17, 0].max() < -0.02, "and the pinky at the other"
    curl = (in_wrist[:, [8, 11, 14, 17], 2] - in_wrist[:, 1:5, 2]).mean(1)
    assert curl.min() > -0.015, "no fingers bend to the hand's back"
    assert (curl.max() > 0.04) == (side == "right"), "the right hand closes, its tips are then on the palm's side"
    quat = np.stack([table[f"q{a}_{side}_device_wrist"][kept] for a in "xyzw"], 1)
    own = Rotation.from_matrix(Rotation.from_quat(quat).as_matrix()[:, :, [2, 0, 1]])
    assert (own.inv() * Rotation.from_matrix(wrist.R_world_body.numpy())).magnitude().max() < np.radians(4)


@pytest.mark.real
def test_real_landmarks_alone_give_nearly_the_same_hands(real_data, tmp_path):
    file = real_data / "aria_mps/hand_tracking/hand_tracking_results_v2.csv"
    wrists, table = real_hands(file)
    older = [
        {name: table[name][k] for name in table if not name.startswith("n")}
        for k in range(len(table["nx_left_palm_device"]))
    ]
    for joint, wrist in real_hands(write(tmp_path / "hand_tracking_results.csv", older))[0].items():
        assert torch.equal(wrist.t_world_body, wrists[joint].t_world_body)
        turn = wrist.R_world_body.mT @ wrists[joint].R_world_body
        assert Rotation.from_matrix(turn.numpy()).magnitude().max() < np.radians(13)


@pytest.mark.real
def test_real_folder_has_the_hand_that_is_in_view(real_data):
    """The sample's wrists and palms are on its path's clock: the right hand is seen for half a second.

    Its turn is not tested: this file's normals were added to places of an older version, and lean 40° off them.
    """
    recording = read_mps(real_data / "aria_mps")
    assert list(recording.tracked) == ["right_wrist"]
    track, head = recording.tracked["right_wrist"], recording.head
    assert len(track) == 6
    assert head is not None
    frame = torch.searchsorted(head.timestamps, track.timestamps)
    offset = (head.R_world_device[frame].mT @ (track.t_world_body - head.t_world_device[frame])[..., None])[..., 0]
    assert 0.2 < offset.norm(dim=-1).min() < offset.norm(dim=-1).max() < 0.9
    assert offset[:, 1].max() < -0.1, "to the right of the head"
    assert offset[:, 2].max() < -0.1, "and below it"
