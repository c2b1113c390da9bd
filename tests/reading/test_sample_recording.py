"""The sample recording of README's first capture: it lies in the repository, is sound, and is ECHO's to capture."""

import pytest
import torch

import wearcap
from command_line import exit_code
from wearcap_testing import PROJECT

SAMPLE = PROJECT / "examples" / "headset_walk.csv"


def test_the_sample_is_fifteen_seconds_of_a_person_who_stands_and_then_walks():
    recording = wearcap.read(str(SAMPLE), height=1.74)
    head = recording.head
    assert head is not None
    assert set(recording.tracked) == {"left_wrist", "right_wrist"}
    assert head.timestamps[-1] - head.timestamps[0] == pytest.approx(15.0, abs=0.1)
    speed = head.T_world_head.t[:, :2].diff(dim=0).norm(dim=1) / head.timestamps.diff()
    assert speed[:45].mean() < 0.2
    assert torch.quantile(speed, 0.9) == pytest.approx(1.45, abs=0.3)
    assert str(SAMPLE.relative_to(PROJECT)) in (PROJECT / "README.md").read_text(encoding="utf-8")


def test_the_doctor_finds_all_that_echo_needs_in_the_sample(capsys):
    assert exit_code(["doctor", str(SAMPLE), "for=echo"]) == 0
    assert "0 errors" in capsys.readouterr().out
