"""Exported MocapEvery: the same motion from the file, and files that do not belong together are refused."""

import json
import shutil
import sys
from pathlib import Path
from subprocess import run

import pytest
import torch

from watched_walk import drawn_pipeline, watched_walk
from wearcap.errors import WearcapError
from wearcap.export.files import load_exported, write_exports
from wearcap.recording.store import RecordingFile, save_recording


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    """Report of a pipeline's file in either format."""
    folder, formats = tmp_path_factory.mktemp("mocap_every"), ("onnx", "pt2")
    return {
        format: write_exports(drawn_pipeline().exports(), folder / format / f"net.{format}", format)["network"]
        for format in formats
    }


@pytest.mark.parametrize("format", ["onnx", "pt2"])
def test_the_file_gives_what_the_network_gives(exports, format):
    pipeline, recording, report = drawn_pipeline(), watched_walk(), exports[format]
    assert report.max_abs_error < 1e-4
    motion = load_exported(report.path)(recording)
    torch.testing.assert_close(motion.T_world_joint.t, pipeline(recording).T_world_joint.t, atol=1e-4, rtol=0)
    about = json.loads(Path(report.path).with_suffix(".json").read_text())
    assert about["features"]["frame"] == "heading"
    assert about["window"] == 16


def test_it_runs_without_lightning_and_hydra(exports, tmp_path):
    pytest.importorskip("onnxruntime")
    recording = watched_walk()
    save_recording(recording, tmp_path / "walk.safetensors")
    program = (
        "import sys; from wearcap.export.__main__ import main; main(sys.argv[1:]); "
        "assert not {'lightning', 'hydra', 'omegaconf'} & set(sys.modules)"
    )
    run(
        [
            sys.executable,
            "-c",
            program,
            exports["onnx"].path,
            tmp_path / "walk.safetensors",
            tmp_path / "out.safetensors",
        ],
        check=True,
    )
    motion = RecordingFile(tmp_path / "out.safetensors").load().motion
    assert motion is not None
    assert len(motion) == len(recording.head.timestamps)


def test_a_sidecar_of_another_network_is_refused(exports, tmp_path):
    own = shutil.copytree(Path(exports["pt2"].path).parent, tmp_path, dirs_exist_ok=True)
    about = json.loads((tmp_path / "net.json").read_text())
    (tmp_path / "net.json").write_text(json.dumps(about | {"network": "contact"}))
    with pytest.raises(WearcapError):
        load_exported(own / "net.pt2")
