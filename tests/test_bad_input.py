"""Bad input through the command line: one clear message, an exit code, nothing half-written."""

import errno
import gzip
import json
import os
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import exit_code, files_in
from wearcap.cli import train
from wearcap.io.formats.bvh import write_bvh
from wearcap.io.formats.motion_npz import write_motion
from wearcap.recording import ImuStream, Recording, RecordingStore
from wearcap_testing import recording_of, small_dataset, suited, swaying_motion

SMALL = [
    "debug=fast",
    "data.dataset.window=60",
    "trainer.accelerator=cpu",
    "model.net.transformer.width=32",
    "model.net.transformer.layers=1",
    "model.net.transformer.heads=4",
    "model.net.transformer.feedforward=32",
    "trainer.enable_progress_bar=false",
    "trainer.enable_model_summary=false",
    "callbacks.progress=null",
]


def motion_file(write, name: str) -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        write(swaying_motion(40), Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def arrays(**content) -> bytes:
    import io

    stream = io.BytesIO()
    np.savez(stream, **content)
    return stream.getvalue()


MPS = "graph_uid,tracking_timestamp_us,utc_timestamp_ns,tx_world_device,ty_world_device,tz_world_device\n0,1,2,3"
PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 100\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
PCD = b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 100\nHEIGHT 1\nPOINTS 100\nDATA binary\n"
SAFETENSORS = struct.pack("<Q", 1000) + b'{"__metadata__": {}'
CUT_SHORT = {
    "a.bvh": lambda: motion_file(write_bvh, "a.bvh")[:-500],
    "motion.npz": lambda: motion_file(write_motion, "a.npz")[:-500],
    "amass.npz": lambda: arrays(poses=np.zeros((9, 156)), trans=np.zeros((9, 3)), mocap_framerate=60)[:-90],
    "xdata.npz": lambda: arrays(segment_qWXYZ=np.zeros((9, 92)), segment_tXYZ=np.zeros((9, 69)))[:-90],
    "a.mvnx": lambda: b'<?xml version="1.0"?><mvnx version="4"><subject label="a" frameRate="60"><segments><segm',
    "a.amc": lambda: b"#!OML:ASF\n:FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\n2\nroot 0 0",
    "closed_loop_trajectory.csv": lambda: MPS.encode(),
    "closed_loop_trajectory.csv.gz": lambda: gzip.compress(MPS.encode())[:-12],
    "aria_trajectory.csv": lambda: MPS.encode(),
    "euroc.csv": lambda: b"#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n1000,0,0,0,1,0,0,0\n2000,0,0",
    "tum.txt": lambda: b"0.0 1 2 3 0 0 0 1\n0.1 1 2",
    "a.ply": lambda: PLY + b"\0" * 100,
    "a.pcd": lambda: PCD + b"\0" * 100,
    "a.safetensors": lambda: SAFETENSORS,
}
DAMAGE = {
    "empty": lambda name: b"",
    "garbage": lambda name: bytes(range(256)) * 4,
    "cut short": lambda name: CUT_SHORT[name](),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", CUT_SHORT)
def test_a_damaged_file_is_one_error(name, damage, tmp_path, capsys):
    (tmp_path / name).write_bytes(DAMAGE[damage](name))
    (tmp_path / "a.asf").write_text(":version 1.10\n:units\n:root\n")
    assert exit_code(["doctor", "--json", str(tmp_path / name)]) == 1
    report = json.loads(capsys.readouterr().out)
    found = [finding for findings in report["findings"].values() for finding in findings]
    assert [finding["severity"] for finding in found] == ["error"]
    assert found[0]["check"] == "reading"
    assert "Error" not in found[0]["what"], "a library's exception came through"
    assert files_in(tmp_path) == {name, "a.asf"}


# Verbs -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, Path]:
    """A small data set and a checkpoint trained on it."""
    root = tmp_path_factory.mktemp("trained")
    data = small_dataset(root / "data").root
    train.main([f"data.sources.simulated.root={data}", f"hydra.run.dir={root}/run", *SMALL])
    return data, root / "run/checkpoints/last.ckpt"


def brief_dataset(root: Path) -> Path:
    """Three frames in every recording."""
    return small_dataset(root, (3,) * 6).root


def truncated_dataset(root: Path) -> Path:
    store = small_dataset(root)
    for name in store.names():
        path = store.path_of(name)
        path.write_bytes(path.read_bytes()[:-2000])
    return root


def one_watch(root: Path) -> Path:
    """A recording of one watch's accelerations, which suits no pipeline."""
    watch = ImuStream(torch.arange(60, dtype=torch.float64) / 50, "left_wrist", acc_imu=torch.ones(60, 3))
    RecordingStore(root / "kit").add(Recording("one", imu={"left_wrist": watch}), split="test", config_hash="x")
    return root / "kit"


def still_dataset(root: Path) -> Path:
    """Recordings whose clock stands still: a frame rate of 0."""
    store = small_dataset(root)
    store.register({name: replace(entry, fps=0.0) for name, entry in store.entries.items()})
    return root


def other_checkpoint(path: Path, checkpoint: Path) -> Path:
    saved = torch.load(checkpoint, weights_only=True)
    saved["state_dict"] = {"other." + key: value for key, value in saved["state_dict"].items()}
    torch.save(saved, path)
    return path


def training(data: Path, out: Path, *more: str) -> list[str]:
    return ["train", f"data.sources.simulated.root={data}", f"hydra.run.dir={out}", *SMALL, *more]


def with_checkpoint(verb: str, checkpoint: Path, out: Path, *more: str) -> list[str]:
    written = {"evaluate": f"output={out}/table.json", "export": f"output={out}/d.onnx", "capture": "video=false"}
    return [verb, f"checkpoint={checkpoint}", f"hydra.run.dir={out}", "pipeline.sampling.steps=2", written[verb], *more]


def hps(data: Path, out: Path, *more: str) -> list[str]:
    """Capture the data set's only recording, or r4."""
    recording = data / "r4" if (data / "recordings/r4.safetensors").is_file() else data
    return ["capture", "pipeline=hps", f"recording={recording}", f"hydra.run.dir={out}", "video=false", *more]


ROWS = {
    "train: no data set": (lambda data, ckpt, tmp, out: training(tmp / "none", out), "no data set here"),
    "train: three frames": (
        lambda data, ckpt, tmp, out: training(brief_dataset(tmp / "brief"), out),
        "no windows in split 'train'",
    ),
    "train: cut short": (
        lambda data, ckpt, tmp, out: training(truncated_dataset(tmp / "cut"), out),
        "It was cut short or replaced",
    ),
    "train: fps 0": (lambda data, ckpt, tmp, out: training(still_dataset(tmp / "still"), out), "0.0 frames per second"),
    "train: typo": (
        lambda data, ckpt, tmp, out: training(data, out, "trainer.max_step=3"),
        "Did you mean 'trainer.max_steps'",
    ),
    "train: a value the model refuses": (
        lambda data, ckpt, tmp, out: training(data, out, "model.net.transformer.width=191"),
        "cannot build model: width 191 must be",
    ),
    "train: resume": (
        lambda data, ckpt, tmp, out: training(data, out, "resume=none.ckpt"),
        "no such checkpoint to resume from",
    ),
    "evaluate: other model": (
        lambda data, ckpt, tmp, out: with_checkpoint("evaluate", other_checkpoint(tmp / "o.ckpt", ckpt), out),
        "weights of this model",
    ),
    "export: other model": (
        lambda data, ckpt, tmp, out: with_checkpoint("export", other_checkpoint(tmp / "o.ckpt", ckpt), out),
        "weights of this model",
    ),
    "capture: other model": (
        lambda data, ckpt, tmp, out: with_checkpoint(
            "capture", other_checkpoint(tmp / "o.ckpt", ckpt), out, f"recording={data}/r4"
        ),
        "weights of this model",
    ),
    "evaluate: three frames": (
        lambda data, ckpt, tmp, out: with_checkpoint("evaluate", ckpt, out, f"dataset={brief_dataset(tmp / 'brief')}"),
        "3 frames",
    ),
    "evaluate: cut short": (
        lambda data, ckpt, tmp, out: with_checkpoint(
            "evaluate", ckpt, out, f"dataset={truncated_dataset(tmp / 'cut')}"
        ),
        "cut short",
    ),
    "evaluate: no data set": (
        lambda data, ckpt, tmp, out: with_checkpoint("evaluate", ckpt, out, f"dataset={tmp}/none"),
        "no data set here",
    ),
    "capture: three frames": (
        lambda data, ckpt, tmp, out: with_checkpoint(
            "capture", ckpt, out, f"recording={brief_dataset(tmp / 'brief')}/r4"
        ),
        "3 frames",
    ),
    "capture: cut short": (
        lambda data, ckpt, tmp, out: with_checkpoint(
            "capture", ckpt, out, f"recording={truncated_dataset(tmp / 'cut')}/r4"
        ),
        "cut short",
    ),
    "capture: no recording": (
        lambda data, ckpt, tmp, out: with_checkpoint("capture", ckpt, out, f"recording={tmp}/none"),
        "no recording here",
    ),
    "capture: no checkpoint": (
        lambda data, ckpt, tmp, out: with_checkpoint("capture", tmp / "none.ckpt", out, f"recording={data}/r4"),
        "no such checkpoint",
    ),
    "capture: a kit that suits nothing": (
        lambda data, ckpt, tmp, out: ["capture", f"recording={one_watch(tmp)}", f"hydra.run.dir={out}"],
        "no pipeline suits this recording: hps lacks a suit's motion",
    ),
    "capture: a checkpoint for nothing": (
        lambda data, ckpt, tmp, out: hps(data, out, f"checkpoint={ckpt}"),
        "a checkpoint, but HPS has no network",
    ),
    "capture: echo with another's checkpoint": (
        lambda data, ckpt, tmp, out: [
            "capture",
            "pipeline=echo",
            f"checkpoint={ckpt}",
            f"recording={data}/r4",
            f"hydra.run.dir={out}",
            "video=false",
        ],
        "experiment=echo",
    ),
    "train: echo without objects' files": (
        lambda data, ckpt, tmp, out: [
            "train",
            "experiment=echo",
            f"paths.datasets={tmp}/none",
            "data.dataset.content.encoder=null",
            f"hydra.run.dir={out}",
        ],
        "no data set here",
    ),
    "capture: stages of a pipeline without": (
        lambda data, ckpt, tmp, out: with_checkpoint("capture", ckpt, out, f"recording={data}/r4", "until=align"),
        "until=align cache=None",
    ),
    "hps: no suit": (lambda data, ckpt, tmp, out: hps(data, out), "r4: no suit and no camera in this recording"),
    "hps: no camera": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d", camera=None), out),
        "r: no camera in this recording",
    ),
    "hps: no poses, no map": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d", localization=None), out),
        "no localisation in this recording, and no map",
    ),
    "hps: no such map": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d"), out, "pipeline.localization.map=none.map"),
        "none.map: no such map",
    ),
    "hps: no scan": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d"), out),
        "no scan of the scene, which the energy's term contact_plane needs",
    ),
    "hps: a scene without a cloud": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d"), out, f"scene={data}"),
        "no scan of a scene here",
    ),
    "hps: no clap": (
        lambda data, ckpt, tmp, out: hps(
            suited(tmp / "d"),
            out,
            "pipeline=paper/hps_without_scene",
            "pipeline.synchronization.clock=claps",
            "pipeline.synchronization.camera_claps_s=[1.0]",
        ),
        "no clap found",
    ),
    "hps: a clock that is none": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d"), out, "pipeline.synchronization.clock=clap"),
        "clock='clap'",
    ),
    "hps: contacts shorter than poses": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d", short=True), out),
        "Motion.contact_prob has 50 rows for 90 timestamps",
    ),
    "hps: no stage": (
        lambda data, ckpt, tmp, out: hps(suited(tmp / "d"), out, "pipeline=paper/hps_without_scene", "until=optimise"),
        "no stage 'optimise'",
    ),
    "evaluate: no data set for hps": (
        lambda data, ckpt, tmp, out: ["evaluate", "pipeline=hps", f"hydra.run.dir={out}", f"output={out}/t.json"],
        "dataset has no value",
    ),
    "prepare: no folder": (
        lambda data, ckpt, tmp, out: ["prepare", "cmu", f"source={tmp}/none", f"output={out}"],
        "no such folder",
    ),
    "prepare: typo": (
        lambda data, ckpt, tmp, out: ["prepare", "cmu", "sorce=x", f"output={out}"],
        "Did you mean 'source'",
    ),
    "view: no recording": (lambda data, ckpt, tmp, out: ["view", f"{tmp}/none"], "no recording here"),
    "render: no recording": (
        lambda data, ckpt, tmp, out: ["render", f"{tmp}/none", "--out", f"{out}/a.png"],
        "no recording here",
    ),
    "prepare hps: no folder": (
        lambda data, ckpt, tmp, out: ["prepare", "hps", f"source={tmp}/none", f"output={out}"],
        "no such folder",
    ),
    "calibrate: no video": (
        lambda data, ckpt, tmp, out: [
            "calibrate",
            f"source={tmp}/none.mp4",
            "columns=9",
            "rows=6",
            "square_m=0.02",
            f"hydra.run.dir={out}",
            f"output={out}/camera.json",
        ],
        "no such file or folder",
    ),
    "calibrate: no square": (
        lambda data, ckpt, tmp, out: ["calibrate", f"source={tmp}", "columns=9", "rows=6", f"hydra.run.dir={out}"],
        "square_m has no value",
    ),
    "doctor: nothing there": (lambda data, ckpt, tmp, out: ["doctor", f"{tmp}/none"], "no such file or folder"),
}


@pytest.mark.parametrize("row", ROWS)
def test_a_verb_reports_it_once_and_leaves_nothing(row, trained, tmp_path, capfd, trusted):
    arguments, message = ROWS[row]
    out = tmp_path / "out"
    out.mkdir()
    command = arguments(*trained, tmp_path, out)
    capfd.readouterr()
    assert exit_code(command) == 2
    printed = [line for line in capfd.readouterr().err.splitlines() if line.strip()]
    assert len(printed) == 1, printed
    assert printed[0].startswith(f"wearcap {command[0]}: ")
    assert message in printed[0]
    assert not files_in(out)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (errno.ENOSPC, "the disk is full. Free some space"),
        (errno.EACCES, "no permission to write here. Choose another"),
    ],
)
@pytest.mark.parametrize("verb", ["train", "evaluate", "capture", "export", "prepare", "render"])
def test_a_full_disk_and_a_locked_folder(verb, fault, message, trained, tmp_path, capfd, monkeypatch):
    data, checkpoint = trained
    out = tmp_path / "out"
    (tmp_path / "source").mkdir()
    write_bvh(swaying_motion(90), tmp_path / "source/a.bvh")
    command = {
        "train": lambda: training(data, out),
        "evaluate": lambda: with_checkpoint("evaluate", checkpoint, out, "seeds=[0]", "baselines=false"),
        "capture": lambda: with_checkpoint("capture", checkpoint, out, f"recording={data}/r4", "body=false"),
        "export": lambda: with_checkpoint("export", checkpoint, out, "format=pt2", f"output={out}/d.pt2"),
        "prepare": lambda: ["prepare", "cmu", f"source={tmp_path}/source", f"output={out}", "jobs=1"],
        "render": lambda: ["render", f"{data}/r4", "--out", f"{out}/a.png", "--sticks"],
    }[verb]()

    def refuse(*_):
        raise OSError(fault, os.strerror(fault), "somewhere")

    monkeypatch.setattr("wearcap.files.os.replace", refuse)
    capfd.readouterr()
    assert exit_code(command) == 2
    printed = [line for line in capfd.readouterr().err.splitlines() if line.startswith("wearcap ")]
    assert len(printed) == 1
    assert message in printed[0]
    assert not files_in(out)


@pytest.mark.parametrize("fault", ["NaN joints", "fps 0", "three frames"])
def test_what_cannot_be_prepared_is_named_and_left_out(fault, tmp_path, capfd):
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    for name in ("good", "bad"):
        write_bvh(swaying_motion(90), source / f"{name}.bvh")
    lines = (source / "bad.bvh").read_text().splitlines()
    place = next(i for i, line in enumerate(lines) if line.startswith("Frame Time"))
    if fault == "NaN joints":
        lines[place + 5] = "nan " + lines[place + 5].split(" ", 1)[1]
    elif fault == "fps 0":
        lines[place] = "Frame Time: 0"
    else:
        lines[place - 1 :] = ["Frames: 3", *lines[place : place + 4]]
    (source / "bad.bvh").write_text("\n".join(lines) + "\n")
    assert exit_code(["prepare", "cmu", f"source={source}", f"output={out}", "jobs=1"]) == 1
    printed = [line for line in capfd.readouterr().err.splitlines() if line.startswith("failed: ")]
    assert len(printed) == 1
    assert "bad" in printed[0]
    assert RecordingStore.open(out).names() == ["good"]
    assert files_in(out) == {"manifest.json", "recordings/good.safetensors"}


def test_a_recording_with_nan_joints_is_named_by_the_doctor(tmp_path, capsys):
    motion = swaying_motion(90)
    motion.R_parent_joint[7, 3] = torch.nan
    RecordingStore(tmp_path).add(recording_of(motion, "r"), split="test", config_hash="x")
    assert exit_code(["doctor", str(tmp_path)]) == 1
    assert "NaN" in capsys.readouterr().out
