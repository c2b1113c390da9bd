"""`wearcap capture` and `wearcap evaluate` with HPS: files, report, cache; no checkpoint."""

import json
import sys
from pathlib import Path

import av
import numpy as np
import pytest

from benchmarks.rivals import SEARCH
from wearcap.cli import capture, evaluate
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.io.formats.camera_json import write_camera
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording.store import load_recording


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    sys.path.append(str(Path(__file__).parents[1] / "pipelines"))
    from hps_walk import hps_dataset, hps_recording

    root = tmp_path_factory.mktemp("data")
    hps_dataset(root, hps_recording("walk", 12.0), hps_recording("other", 6.0))
    return root


def arguments(data: Path, out: Path, *more: str) -> list[str]:
    return ["pipeline=hps", "pipeline.solver.settings.iterations=3", f"hydra.run.dir={out}", *more]


def capturing(data: Path, out: Path, *more: str) -> None:
    capture.main(arguments(data, out, f"recording={data}/walk", "body=false", "video=0.2", *more))


def test_a_recording_becomes_files_and_a_report(data, tmp_path, capfd):
    out, cache = tmp_path / "out", f"cache={tmp_path / 'cache'}"
    capturing(data, out, cache, "until=initialize", "video=false")
    start = read_motion(out / "motion.npz")
    assert "initialize: " in capfd.readouterr().err
    capturing(data, out, cache)
    printed = capfd.readouterr().err
    assert "initialize: reused" in printed
    assert "optimize: reused" not in printed
    assert {path.name for path in out.glob("motion.*")} == {"motion.npz", "motion.bvh", "motion.glb", "motion.mp4"}
    report = json.loads((out / "report.json").read_text())
    assert [stage["reused"] for stage in report["stages"]] == [True] * 4 + [False] * 2
    assert report["localized"]["share"] == 1.0
    motion = read_motion(out / "motion.npz")
    assert motion.provenance["pipeline"] == "hps"
    assert len(motion) == len(start) == 360
    assert (motion.t_world_root - start.t_world_root).abs().max() > 1e-3


def test_a_stage_before_any_motion_leaves_its_report(data, tmp_path):
    capturing(data, tmp_path, "until=localize")
    assert {path.name for path in tmp_path.glob("*.*") if path.is_file()} >= {"report.json"}
    assert not (tmp_path / "motion.npz").exists()


def test_another_scene_can_be_given(data, tmp_path):
    capturing(data, tmp_path, f"scene={data}/scene", "video=false")
    with pytest.raises(WearcapError, match="no scan of a scene here"):
        capturing(data, tmp_path, f"scene={data}", "video=false")


def test_a_data_set_is_scored(data, tmp_path, capfd):
    table = tmp_path / "table.json"
    evaluate.main(arguments(data, tmp_path, f"dataset={data}", f"output={table}", f"cache={tmp_path / 'cache'}"))
    written = json.loads(table.read_text())
    assert written["about"]["dataset"] == str(data)
    scores = written["methods"]["hps"]
    assert scores["world_root_cm"]["mean"] < 8
    assert {path.name for path in (tmp_path / "cache").iterdir()} == {"walk", "other"}
    suit = [SEARCH, "pipeline=baseline/hps_suit", "pipeline.kind=imu"]
    evaluate.main([*suit, f"dataset={data}", f"output={table}", f"hydra.run.dir={tmp_path}"])
    imu = json.loads(table.read_text())["methods"]["imu"]
    assert imu["world_root_cm"]["mean"] > scores["world_root_cm"]["mean"]


def test_localisation_by_learned_features_is_a_choice():
    chosen = compose("capture", ["pipeline=paper/hps", "recording=x", "localization@pipeline.localization=disk"])
    assert chosen.pipeline.localization.extractor._target_.endswith("DiskExtractor")
    assert chosen.pipeline.localization._target_.endswith("MapLocalization")


def test_the_pages_way_to_a_recording_of_ones_own(tmp_path, monkeypatch):
    """docs/hps.md: MVNX, video and camera become a recording that can be loaded."""
    sys.path.append(str(Path(__file__).parents[1] / "io"))
    from test_mvnx import mvnx, sample

    page = (Path(__file__).parents[2] / "docs/hps.md").read_text(encoding="utf-8")
    own = tmp_path / "own"
    own.mkdir()
    (own / "walk.mvnx").write_text(mvnx(sample(30)))
    write_camera(Camera.pinhole(64, 48, 60.0), own / "camera.json")
    with av.open(str(own / "walk.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for shade in range(9):
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 20 * shade, np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    monkeypatch.chdir(tmp_path)
    exec(page.split("```python")[1].split("```")[0], {})
    recording = load_recording("own/walk")
    assert len(recording.camera.timestamps) == 9
    assert recording.suit.contact_prob is not None
    assert "head" in recording.imu
    with pytest.raises(WearcapError, match="no localisation in this recording, and no map"):
        # The take is made of random numbers.
        capture.main([*arguments(own, tmp_path / "out"), "recording=own/walk", "check=false"])
