"""Every format of a motion, read by readers that are not wearcap's."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from wearcap_testing import swaying_motion

pytest.importorskip("pxr.Usd")

from benchmarks.faults.round_trips import rows_of


def test_joints_are_within_a_millimetre_and_times_exact(tmp_path: Path):
    motion = replace(swaying_motion(40, 3), timestamps=torch.arange(40, dtype=torch.float64) / 30 + 12.5)
    for ending, reader, joints, worst_mm, late_ms in rows_of(motion, tmp_path, None, None):
        assert worst_mm < 0.1, (ending, reader)
        assert (late_ms or 0.0) < 0.01, (ending, reader)
        assert joints in (0, len(motion.skeleton), 52)


def test_a_joint_that_is_off_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import wearcap

    motion, save = swaying_motion(20, 3), wearcap.save
    moved = replace(motion, t_world_root=motion.t_world_root + torch.tensor([0.0, 0.002, 0.0]))
    monkeypatch.setattr(wearcap, "save", lambda _, path: save(moved, path))
    found = {ending: worst_mm for ending, _, joints, worst_mm, _ in rows_of(motion, tmp_path, None, None) if joints}
    assert all(abs(worst_mm - 2.0) < 0.2 for worst_mm in found.values()), found
