"""A recorded walk as a sheet: cycles seen from the side, and figures that are those of the body and the floor."""

import importlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from normal_walk import walk
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis
from wearcap.metrics.gait import STANCE, normal_knee_deg
from wearcap.recording import PointCloud, RecordingStore
from wearcap.recording.motion import Motion
from wearcap.runtime.system import Captured, System
from wearcap_testing import recording_of

FLOOR_M = 0.4


class Walks(System):
    """A system that captures the same motion of everybody."""

    def __init__(self, motion: Motion):
        self.motion, self.seen = motion, []

    def capture(self, recordings, seeds, options=None):
        self.seen += [source.recording for source in recordings]
        return [Captured(self.motion) for _ in recordings]


@pytest.fixture
def sheets():
    return importlib.import_module("benchmarks.pictures.contact_sheets")


@pytest.fixture
def walker() -> Motion:
    """Stiff ankles 3 cm over a floor, turned to where no axis is."""
    motion = walk(12.0, seconds=6.0)
    low = motion.T_world_joint.t[..., 2].amin(1).quantile(0.1).item()
    return motion.moved(Rigid(about_axis("z", torch.tensor(1.0)), torch.tensor([0.0, 0.0, FLOOR_M - low + 0.05])))


@pytest.fixture
def recorded(walker, tmp_path) -> Path:
    """The head's path over a floor's points, without a body."""
    around = torch.rand(20_000, 2, generator=torch.Generator().manual_seed(0)) * 16 - 8
    points = torch.cat([around, torch.full((len(around), 1), FLOOR_M)], 1)
    cloud = PointCloud(points, torch.ones(len(points)))
    bare = replace(
        recording_of(walker, "somebody"), motion=None, skeleton=None, floor=None, contacts=None, points=cloud
    )
    RecordingStore(tmp_path / "set").add(bare, split="test", config_hash="test")
    return tmp_path / "set" / "somebody"


def test_a_walk_is_drawn_and_measured(sheets, walker, recorded, tmp_path, monkeypatch, capsys):
    system = Walks(walker)
    monkeypatch.setattr(sheets, "load_pipeline", lambda *_: system)
    sheets.main(["hmd2", "--walk", str(recorded), "--output", str(tmp_path)])
    figures = json.loads((tmp_path / "hmd2_somebody.json").read_text())
    assert json.loads(capsys.readouterr().out) == figures
    assert system.seen[-1].motion is None
    assert figures["stature_m"] == pytest.approx(system.seen[-1].skeleton.stature, abs=1e-3)
    assert figures["cycles"] >= 6
    assert figures["stance_knee_deg"] == pytest.approx(normal_knee_deg()[STANCE].mean().item() + 12, abs=1)
    sites = [walker.skeleton.sites[f"{side}_toe_tip"] for side in ("left", "right")]
    tips = [(walker.joint(site.joint) @ torch.tensor(site.t_joint_site))[:, 2] for site in sites]
    lower = 100 * (torch.minimum(*tips) - FLOOR_M)
    assert figures["toe_cm"] == pytest.approx(lower.median().item(), abs=1), "cycles repeat"
    assert figures["toe_5_cm"] < figures["toe_cm"] < figures["toe_95_cm"]
    picture = np.asarray(Image.open(tmp_path / "hmd2_somebody.png"))
    assert picture.shape == (3 * (sheets.SIZE[1] + sheets.BAND), sheets.COLUMNS * sheets.SIZE[0], 3)


def test_who_stands_has_no_sheet(sheets, walker, recorded):
    still = replace(walker, t_world_root=walker.t_world_root[:1].expand(len(walker), 3))
    with pytest.raises(WearcapError, match="no cycle of straight, level walking"):
        sheets.walk(Walks(still), recorded)
