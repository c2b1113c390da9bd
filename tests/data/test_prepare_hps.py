"""The HPS data set's folders to a data set."""

from pathlib import Path

import pytest
import torch

from wearcap.cli import prepare as verb
from wearcap.errors import WearcapError
from wearcap.recording import Motion, RecordingStore
from wearcap.recording.timing import resampled
from wearcap_testing import swaying_motion


@pytest.fixture
def files(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "io")
    import hps_files

    return hps_files


def test_sequences_become_recordings(tmp_path, files):
    truth = files.write_hps(tmp_path / "in")
    arguments = ["hps", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1"]
    verb.main(arguments)
    store = RecordingStore.open(tmp_path / "out")
    entry = store.entries[files.NAME]
    assert (entry.context.subject, entry.context.location, entry.split, entry.fps) == ("SUB4", files.SCAN, "test", 30.0)
    recording = store.load(files.NAME)
    assert recording.motion is not None
    assert recording.suit is not None
    assert recording.localization is not None
    assert recording.camera is not None
    torch.testing.assert_close(recording.motion.t_world_root, truth.t_world_root)
    assert (store.root / (recording.scene or "")).is_file()
    verb.main(arguments)
    assert RecordingStore.open(tmp_path / "out").entries[files.NAME].sha256 == entry.sha256


def test_a_changed_file_is_prepared_again(tmp_path, files):
    files.write_hps(tmp_path / "in", scan=False)
    arguments = ["hps", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1"]
    verb.main(arguments)
    before = RecordingStore.open(tmp_path / "out").entries[files.NAME].config_hash
    (tmp_path / "in/hps_inits" / f"{files.NAME}.json").write_text('{"cam_start": 21, "imu_start": 30}')
    verb.main(arguments)
    assert RecordingStore.open(tmp_path / "out").entries[files.NAME].config_hash != before


def test_29_97_hz_becomes_30(tmp_path, files):
    files.write_hps(tmp_path / "in", scan=False)
    verb.main(["hps", f"source={tmp_path / 'in'}", f"output={tmp_path / 'out'}", "jobs=1", "camera_hz=29.97"])
    found = RecordingStore.open(tmp_path / "out").load(files.NAME).localization
    assert found is not None
    assert found.timestamps.diff().median().item() == pytest.approx(1 / 30)


def test_a_folder_without_sequences_is_refused(tmp_path):
    with pytest.raises(WearcapError, match="no sequences"):
        verb.main(["hps", f"source={tmp_path}", f"output={tmp_path / 'out'}"])


@pytest.mark.parametrize("fps", [30.0, 25.0])
def test_contacts_are_resampled_with_the_motion(fps):
    motion = swaying_motion(61, fps=60.0)
    ramp = torch.linspace(0, 1, 61)[:, None].expand(-1, 4)
    read = resampled(Motion(motion.timestamps, motion.skeleton, motion.R_parent_joint, motion.t_world_root, ramp), fps)
    assert read.contact_prob is not None
    torch.testing.assert_close(read.contact_prob[:, 2], read.timestamps.float(), atol=1e-5, rtol=0)
