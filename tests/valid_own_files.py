"""Readers of recordings, weights, checkpoints, exports, maps, settings and scenes, and of live messages, with valid files."""

import dataclasses
import json
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
import trimesh
import yaml
from safetensors.torch import save_file

import valid_files

sys.path[:0] = [str(valid_files.TESTS / folder) for folder in ("models", "pipelines", "recording")]

import test_checkpoint_files  # noqa: E402
import test_doctor_scene  # noqa: E402
import test_store  # noqa: E402

from sound_packets import SOUND  # noqa: E402
from valid_files import Reader, made, one  # noqa: E402
from wearcap.apps.annotate.takes import starting_labels  # noqa: E402
from wearcap.apps.doctor import examine  # noqa: E402
from wearcap.apps.live.setup import Setup, head_seat, read_setup, write_setup  # noqa: E402
from wearcap.apps.live.sources import source_of  # noqa: E402
from wearcap.apps.viewer.page_layers import read_scene  # noqa: E402
from wearcap.body.skeleton import xsens23  # noqa: E402
from wearcap.boundary import arrays, tensors, texts  # noqa: E402
from wearcap.boundary.own import trusting  # noqa: E402
from wearcap.errors import WearcapError  # noqa: E402
from wearcap.export.files import load_exported, sidecar_path, write_exports  # noqa: E402
from wearcap.files import sha256_of  # noqa: E402
from wearcap.io.conventions import Conventions  # noqa: E402
from wearcap.io.formats import video  # noqa: E402
from wearcap.localization.visual_map import VisualMap  # noqa: E402
from wearcap.models import checkpoint, weights  # noqa: E402
from wearcap.prepare.foreign_conventions import read_mapping  # noqa: E402
from wearcap.reading.any_file import read  # noqa: E402
from wearcap.recording import PointCloud, Recording, RecordingStore  # noqa: E402
from wearcap.recording.store import RecordingFile, save_recording  # noqa: E402
from wearcap.runtime.stages import Stage, StageCache, StagedSystem  # noqa: E402
from wearcap.systems.ireplica.contact_prediction import ContactDetector, ContactPredictor  # noqa: E402
from wearcap.systems.ireplica.contact_sequence import ContactSequence  # noqa: E402
from wearcap.systems.ireplica.export import exports  # noqa: E402
from wearcap.systems.ireplica.features import HandViews  # noqa: E402
from wearcap.systems.ireplica.object_tracker import ObjectTracker  # noqa: E402
from wearcap.systems.ireplica.pipeline import IReplica  # noqa: E402
from wearcap.training import run  # noqa: E402
from wearcap.training.loggers import read_metrics  # noqa: E402
from wearcap_testing import recording_of, swaying_motion  # noqa: E402

NAMED = {"net.weight": torch.ones(4, 3), "net.bias": torch.zeros(4, dtype=torch.bfloat16), "count": torch.tensor([7])}
RUN_YAML = yaml.safe_dump(
    {
        "seed": 3,
        "name": "a",
        "paths": {"run": "out/a", "data": "out/a/d"},
        "model": {"width": 8, "parts": [1, 2.5, None]},
    }
)
MAPPING = "joints: {left_knee: LeftLeg, right_knee: RightLeg}\nunit: cm\nup: y\nforward: z\n"
METRICS = "step,train/loss,val/error\n1,0.5,\n2,0.25,1\n"
LABELS = json.dumps({"contacts": {"left_hand": [[0.5, 1.0]], "right_hand": [[1.5, 0.0]]}, "objects": {}})


def _recording(name: str = "all") -> Recording:
    """A recording with every part, of a few frames."""
    whole = test_store.full_recording(name)
    return dataclasses.replace(whole, points=PointCloud(torch.randn(6, 3)))


def _tiny(name: str) -> Recording:
    return dataclasses.replace(recording_of(swaying_motion(12), name), subject="s")


def _data_set(folder: Path) -> None:
    store = RecordingStore(folder)
    for name in "ab":
        store.add(_tiny(name), split="train", config_hash="1")


def _read_set(folder: Path) -> None:
    store = RecordingStore.open(folder)
    for name in store.names():
        store.load(name)


def _read_tensors(path: Path) -> None:
    """Both readers of .safetensors; every tensor's bytes are touched."""
    for value in tensors.read_tensors(path, "file")[1].values():
        value.clone()
    file = tensors.open_tensors(path, "file")
    for name in file.keys():  # noqa: SIM118
        if file.get_slice(name).get_shape():
            file.get_slice(name)[:1]


def _trusted(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    def reading(path: Path) -> Any:
        with trusting(True):
            return read(path)

    return reading


def _trained(path: Path) -> None:
    """A small shared checkpoint without its checksum, so that damaged ones are built."""
    config, state = checkpoint.read_checkpoint("contact_sequence")
    save_file(state, path, {"wearcap_checkpoint": json.dumps(config)})


def _ckpt(path: Path) -> None:
    test_checkpoint_files.run_file(path, training={"frames": 2.0})


class _Unregistered(StagedSystem):
    stages = motion_of = None


def _exported(folder: Path) -> None:
    """An exported contact network with drawn weights."""
    features = HandViews()
    net = ContactSequence(features.size, width=4, dilations=(1, 2, 4, 6)).eval()
    predictor = ContactPredictor(ContactDetector(net, features, ("sliding", "hinged")))
    write_exports(exports(IReplica(_Unregistered(), predictor, ObjectTracker(None))), folder / "net.onnx", "onnx")


def _read_exported(folder: Path) -> None:
    """The export, whose sidecar gets the damaged file's checksum."""
    path = folder / "net.onnx"
    try:
        about = texts.read_json_object(sidecar_path(path))
        about["model"]["sha256"] = sha256_of(path)
        sidecar_path(path).write_text(json.dumps(about))
    except (WearcapError, LookupError, TypeError, ValueError):
        pass
    load_exported(path)


def _run(folder: Path) -> None:
    own = folder / "a"
    (own / "checkpoints").mkdir(parents=True)
    _ckpt(own / "checkpoints" / "last.ckpt")
    (own / "config.yaml").write_text(RUN_YAML)
    (own / "metrics.csv").write_text(METRICS)


def _read_run(folder: Path) -> None:
    with trusting(True):
        run.run_to_continue(folder, RUN_YAML)
        read_metrics(folder / "a" / "metrics.csv")
        path = run.resume_path("auto", folder / "a", RUN_YAML)
        assert path is not None
        try:
            run.require_resumable(path, test_checkpoint_files.Net().state_dict())
        except WearcapError as error:
            if "without" not in error.what:
                raise


def _stage(folder: Path) -> None:
    StageCache(folder).write("poses", "ab", {"t": torch.ones(4, 3), "n": [1, 2.5, "x"]}, 1.5)


def _video(path: Path) -> None:
    """Six pictures, in the container that the suffix names."""
    with av.open(str(path), "w", options={"fflags": "bitexact"}) as container:
        stream: Any = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        for k in range(6):
            picture = np.full((32, 48, 3), 20 * k, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


def _scene(path: Path) -> None:
    trimesh.creation.box((1, 2, 3)).export(path)


def _live(name: str) -> Reader:
    """A source that is given one packet of each kind: the files' bytes. All that it refuses is counted, as in a capture."""

    def write(folder: Path) -> None:
        for number, packet in enumerate(SOUND[name](3)):
            (folder / f"{number:02d}.packet").write_bytes(packet)

    def parse(folder: Path) -> None:
        source: Any = source_of(f"{name}://127.0.0.1")
        refused: Counter[str] = Counter()
        for path in sorted(folder.iterdir()):
            source.parse(path.read_bytes(), 1000.0, lambda why: refused.update([why]))

    return Reader(write, parse)


OWN: dict[str, Reader] = {
    "yaml": one("a.yaml", "a: 1\nb:\n  c: [1, 2.5, x]\n  d: {e: null}\n", texts.read_yaml_object),
    "mapping_yaml": one("m.yaml", MAPPING, read_mapping),
    "tensors": made("a.safetensors", lambda path: save_file(NAMED, path, {"about": '{"a": [1]}'}), _read_tensors),
    "packed_json": Reader(
        lambda folder: valid_files.hoi_files.write_zip('{"a": [1, 2.5, null], "b": {"c": "x"}}', folder / "a.zip"),
        lambda folder: arrays.read_packed_json(folder / "a.zip", "one JSON file"),
    ),
    "npy": made("a.npy", lambda path: np.save(path, np.arange(12.0).reshape(3, 4)), arrays.read_npy),
    "weights_pth": made(
        "w.pth", lambda path: torch.save({"state_dict": NAMED, "score": np.float64(3)}, path), weights.read_weights
    ),
    "weights_safetensors": made("w.safetensors", lambda path: save_file(NAMED, path), weights.read_weights),
    "checkpoint_shared": made("c.safetensors", test_checkpoint_files.shared_file, checkpoint.read_checkpoint),
    "checkpoint_run": made("c.ckpt", _ckpt, _trusted(checkpoint.read_checkpoint)),
    "checkpoint_built": made("c.safetensors", _trained, checkpoint.load_trained),
    "recording": made(
        "r.safetensors", lambda path: save_recording(_recording(), path), lambda path: RecordingFile(path).load()
    ),
    "data_set": Reader(_data_set, _read_set),
    "visual_map": made("map.safetensors", lambda path: test_doctor_scene.small_map(3, 5).save(path), VisualMap.load),
    "exported_onnx": Reader(_exported, _read_exported),
    "training_run": Reader(_run, _read_run),
    "stage_cache": Reader(_stage, lambda folder: StageCache(folder).read(Stage("poses", dict, list), "ab")),
    "live_setup": made(
        "s.json", lambda path: write_setup(Setup(xsens23(), {"head": head_seat()}, 0.1), path), read_setup
    ),
    "labels_to_start": one("l.json", LABELS, lambda path: starting_labels(path, _tiny("flat_1"), valid_files.CLOCK)),
    **{f"scene_{kind}": made(f"s.{kind}", _scene, read_scene) for kind in ("ply", "obj", "glb")},
    **{
        f"video_{kind}": made(f"v.{kind}", _video, lambda path: (video.video_info(path), list(video.read_frames(path))))
        for kind in ("mp4", "mkv", "avi")
    },
    **{f"live_{name}": _live(name) for name in SOUND if name != "watch+http"},
    "doctor_recording": made("r.safetensors", lambda path: save_recording(_tiny("r"), path), examine),
    "doctor_map": made("map.safetensors", lambda path: test_doctor_scene.small_map(3, 5).save(path), examine),
    "doctor_data_set": Reader(_data_set, examine),
    "any_file": one("t.txt", valid_files.TUM, lambda path: read(path, Conventions(up="z", axes="head"))),
}
"""Readers by name."""
