"""`wearcap live` on the command line."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

import short_walk
from command_line import exit_code
from wearcap.cli.conf import compose
from wearcap.cli.live import main, with_system
from wearcap.errors import WearcapError
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording.store import save_recording
from wearcap_testing import recording_of, swaying_motion


@pytest.mark.parametrize(
    ("given", "source"),
    [
        ("source=vmc://:39540", ["vmc://:39540"]),
        ("source=vmc://127.0.0.1:39540?wearer=anna", ["vmc://127.0.0.1:39540?wearer=anna"]),
        ("source=[json://:9100,watch://:5555?joint=left_wrist]", ["json://:9100", "watch://:5555?joint=left_wrist"]),
        ("source=replay", ["replay"]),
    ],
)
def test_addresses_need_no_quotes(given: str, source: list[str]):
    config = compose("live", with_system(["system=echo", given, "to=[]"]))
    assert list(config.source) == source
    assert not config.to
    assert config.pipeline._target_.endswith("Echo")


def test_an_unknown_system_and_a_replay_of_nothing_are_named():
    with pytest.raises(WearcapError, match="hmd2"):
        with_system(["system=hmd3"])
    with pytest.raises(WearcapError, match="recording="):
        main(["system=hmd2", "source=replay", "record=none"])
    with pytest.raises(WearcapError, match="nothing leaves.*view=true"):
        main(["system=hmd2", "source=replay"])


@pytest.mark.slow
def test_a_replay_with_the_shared_checkpoint_is_recorded_and_reported(tmp_path: Path):
    save_recording(recording_of(swaying_motion(200, 0), "sway"), tmp_path / "in.safetensors")
    main(
        [
            "system=hmd2",
            "source=replay",
            f"recording={tmp_path / 'in.safetensors'}",
            "speed=inf",
            f"record={tmp_path / 'out'}",
            f"report={tmp_path / 'report.json'}",
            f"hydra.run.dir={tmp_path}",
        ]
    )
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["wearers"]["wearer"]["frames"] == 200
    assert len(read_motion(tmp_path / "out" / "wearer" / "motion.npz")) == 200


@pytest.mark.slow
def test_a_capture_ends_with_its_report_on_sigterm(tmp_path: Path):
    """Also where SIGINT is ignored, as in the background of a shell."""
    command = [sys.executable, "-m", "wearcap.cli.main", "live", "system=hmd2", "source=json://127.0.0.1:0"]
    command += [f"record={tmp_path / 'out'}", f"report={tmp_path / 'report.json'}", f"hydra.run.dir={tmp_path}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("from json"):
            break
    time.sleep(5.0)
    process.terminate()
    assert process.wait(60) == 0
    assert json.loads((tmp_path / "report.json").read_text())["wearers"] == {}


def test_a_replay_as_fast_as_it_goes_needs_no_first_minute(tmp_path, monkeypatch, capfd):
    """A wearer of unknown height: nobody could be looked at in real time."""
    monkeypatch.chdir(tmp_path)
    short_walk.tum(tmp_path / "walk.txt", *short_walk.walk(seconds=6))
    assert (
        exit_code(["live", "system=hmd2", "recording=walk.txt", "speed=inf", "record=rec", "report=report.json"]) == 0
    )
    assert json.loads((tmp_path / "report.json").read_text())["wearers"]["wearer"]["frames"] > 200
