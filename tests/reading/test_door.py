"""At the door: what the doctor calls an error stops the verbs before anything is written; conventions can be stated."""

from pathlib import Path

import numpy as np
import pytest

import short_walk
import wearcap
from command_line import exit_code, files_in
from wearcap.apps.doctor import examine
from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.formats.motion_npz import read_motion
from wearcap.reading import read
from wearcap.recording import RecordingStore
from wearcap_testing import recording_of, swaying_motion

NAMES = {
    "time": "time",
    "head": "head_{quantity}_{axis}",
    "left": "left_hand_{quantity}_{axis}",
    "right": "right_hand_{quantity}_{axis}",
}


@pytest.fixture
def damaged(tmp_path) -> Path:
    """A data set whose one recording lies on its side."""
    recording = recording_of(swaying_motion(90), "only")
    assert recording.motion is not None
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)
    R = recording.motion.R_parent_joint.clone()
    R[:, 0] = R[:, 0].new_tensor(turn) @ R[:, 0]
    root = recording.motion.t_world_root @ R.new_tensor(turn).T
    from dataclasses import replace

    lying = replace(recording, motion=replace(recording.motion, R_parent_joint=R, t_world_root=root))
    RecordingStore(tmp_path / "data").add(lying, split="test", config_hash="")
    return tmp_path / "data"


@pytest.mark.parametrize(
    "command",
    [
        ["capture", "checkpoint=mocap_every", "recording={data}/only", "video=false"],
        ["evaluate", "checkpoint=mocap_every", "dataset={data}", "seeds=[0]", "baselines=false", "jobs=1"],
        ["live", "system=mocap_every", "recording={data}/only", "speed=inf", "record={out}/record"],
    ],
    ids=lambda command: command[0],
)
def test_what_the_doctor_calls_an_error_stops_every_verb(damaged, tmp_path, monkeypatch, capfd, command):
    monkeypatch.chdir(tmp_path)
    assert not examine(damaged).sound
    arguments = [word.format(data=damaged, out=tmp_path / "out") for word in command]
    assert exit_code([*arguments, f"hydra.run.dir={tmp_path}/out"]) == 2
    assert "the doctor finds, " in capfd.readouterr().err
    assert not [name for name in files_in(tmp_path / "out") if name.startswith(("motion", "record"))]
    assert exit_code([*arguments, f"hydra.run.dir={tmp_path}/out", "check=false"]) == 0


def test_nothing_is_prepared_in_which_the_doctor_finds_an_error(tmp_path, capsys):
    time, R, t = short_walk.walk()
    short_walk.tum(tmp_path / "walk.txt", time, R, 100 * t)
    command = ["prepare", "trajectory", f"source={tmp_path}/walk.txt", f"output={tmp_path}/out", "jobs=1"]
    assert exit_code(command) == 1
    assert "accelerate as no head does" in capsys.readouterr().err
    assert not RecordingStore.open(tmp_path / "out").names()
    assert exit_code([*command, "unit=cm"]) == 0
    found = read(tmp_path / "out").head
    assert found is not None
    assert np.abs(found.t_world_device.numpy() - t).max() < 1e-4


def test_a_convention_can_be_stated_on_every_verb_that_reads(tmp_path, monkeypatch, capsys):
    """A trajectory in centimetres: each verb takes the unit in the same words, and passes the doctor with it."""
    monkeypatch.chdir(tmp_path)
    time, R, t = short_walk.walk()
    short_walk.tum(tmp_path / "walk.txt", time, R, 100 * t)
    assert exit_code(["doctor", "walk.txt"]) == 1
    assert exit_code(["doctor", "walk.txt", "unit=cm"]) == 0
    assert exit_code(["render", "walk.txt", "unit=cm", "out=walk.png"]) == 0
    given = ["recording=walk.txt", "hydra.run.dir=out", "video=false", "smpl=false", "body=false"]
    assert exit_code(["capture", *given]) == 2
    assert "unit=0.01" in capsys.readouterr().err
    assert exit_code(["capture", *given, "unit=cm"]) == 0


def test_what_a_format_fixes_cannot_be_stated(tmp_path):
    time, R, t = short_walk.walk()
    short_walk.tum(tmp_path / "walk.txt", time, R, t)
    with pytest.raises(WearcapError, match="quaternion=wxyz has no meaning for it"):
        read(tmp_path / "walk.txt", Conventions(quaternion="wxyz"))
    with pytest.raises(WearcapError, match=r"axes=nonsense.*one of auto, camera, head, openxr"):
        Conventions(axes="nonsense")
    small = wearcap.read(tmp_path / "walk.txt", unit="cm").head
    assert small is not None
    assert small.t_world_device.abs().max() < 0.2
    with pytest.raises(WearcapError, match="unit=0"):
        Conventions(unit=0)


def refusal_of(path: Path) -> WearcapError | None:
    """Why a verb does not take an input; None where it does."""
    try:
        read(path, check=True)
    except WearcapError as error:
        return error
    return None


@pytest.mark.real
def test_a_capture_never_passes_where_the_doctor_finds_an_error(real_data):
    """Every input of users' reports: it comes in sound, or is refused with a line that says what to do."""
    refused = []
    for path in sorted((real_data / "field").iterdir()):
        if path.name == "README.md":
            continue
        errors = [finding for _, finding in examine(path).of_severity("error")]
        refusal = refusal_of(path)
        assert (refusal is not None) == bool(errors), (path.name, refusal, errors)
        if refusal is not None:
            refused.append(path.name)
            assert refusal.fix or refusal.expected, (path.name, refusal)
    assert refused == ["D_bvh_no_frames.bvh", "H_WatchAccelerometer_left.csv", "P_openxr_hands_behind_standing.csv"]


def test_a_map_s_coordinates_can_be_put_back(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    time, R, t = short_walk.walk(seconds=4)
    offset = np.array([458074.64, 5429380.17, 162.9])
    short_walk.tum(tmp_path / "walk.txt", time, R, t + offset)
    given = ["capture", "recording=walk.txt", "hydra.run.dir=out", "video=false", "smpl=false", "body=false"]
    assert exit_code([*given, "map_coordinates=true"]) == 0
    rows = (tmp_path / "out/motion.bvh").read_text().split("Frame Time:")[1].splitlines()[1:]
    root = np.array([[float(word) for word in row.split()[:3]] for row in rows]) / 100  # y up: x is the world's y
    assert np.abs(root[:, [2, 0]] - (offset[:2] + t[:, :2].mean(0))).max() < 4
    assert "45807" in read_motion(tmp_path / "out/motion.npz").provenance["origin"]
