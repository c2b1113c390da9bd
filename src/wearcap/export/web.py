"""A checkpoint as a folder of static files that captures in the browser: page, network, body, sample, libraries.

The page's own files lie in `page/`. What it computes around the network follows the values that are written here, so that
constants have one home. Any server of files will do (`python -m http.server`); nothing is loaded from elsewhere.
"""

import hashlib
import importlib
import importlib.util
import json
import shutil
import tarfile
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from msgspec import convert
from torch import Tensor

from wearcap.body.anny_body import anny_body
from wearcap.body.model import BodyModel
from wearcap.body.skeleton import WRISTS, Skeleton
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json_object
from wearcap.errors import WearcapError
from wearcap.export.files import ExportReport, export_network
from wearcap.fetch import Remote, fetch
from wearcap.files import atomic_path, cache_folder, content_hash, explaining_writes, resource, sha256_of
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.io.devices.aria_mps import R_CPF_DEVICE, T_HEAD_DEVICE, nominal_T_aria_cpf
from wearcap.io.devices.axes import DEVICES, OPENXR, UNITY, WORLDS
from wearcap.io.devices.axes import UPRIGHT as UPRIGHT_AXIS
from wearcap.io.devices.hand_seats import SEATS, palm_of, wrist_of_hand
from wearcap.io.devices.headset_axes import FLOOR_M
from wearcap.io.devices.headset_poses import FROZEN_S
from wearcap.io.formats.gltf import write_glb
from wearcap.recording import Motion, Recording
from wearcap.runtime.graphs import Exports, SkeletonEntry
from wearcap.tracking.floor import CARRIED, LOOK_FRAMES, UPRIGHT_WITHIN_S
from wearcap.tracking.head_path import MAX_GAP_S, MAX_SPEED_M_S, MAX_TURN_RAD_S
from wearcap.tracking.stature import HEIGHTS_M, UPRIGHT
from wearcap.tracking.wrists import UNSEEN_S

VERSION = 1
"""Version of the folder's `network.json`."""
PAGE = Path(__file__).with_name("page")
MAX_SAMPLE_S = 60.0
"""Longest part (s) of a recording that becomes the folder's sample."""
LIBRARIES = {
    "three": (
        "LICENSE",
        "build/three.module.js",
        "build/three.core.js",
        "examples/jsm/controls/OrbitControls.js",
        "examples/jsm/loaders/GLTFLoader.js",
        "examples/jsm/utils/BufferGeometryUtils.js",
        "examples/jsm/utils/SkeletonUtils.js",
    ),
    "onnxruntime-web": ("README.md", "dist/ort.wasm.bundle.min.mjs", "dist/ort-wasm-simd-threaded.wasm"),
}
"""Files of npm's packages that the page loads, by the packages that `integrations/web/package-lock.json` locks."""
MAX_TARBALL = 256 << 20
"""Most bytes of a package that is downloaded."""


def page_exports(system: Any) -> Exports:
    """What a system's page runs. Raises WearcapError for a system without one."""
    name = f"wearcap.systems.{system.name}.web"
    if importlib.util.find_spec(name) is None:
        found = sorted(path.parent.name for path in Path(__file__).parents[1].glob("systems/*/web.py"))
        raise WearcapError(f"no page for {system.name}", expected=f"a checkpoint of {', '.join(found)}")
    return importlib.import_module(name).exports(system)


def write_page(exports: Exports, folder: str | Path, recording: Recording, libraries: Path) -> ExportReport:
    """Write the folder with a sample of the recording; `libraries` holds npm's packages of `LIBRARIES`.

    The folder appears when all of it is written, and replaces a page that was there. Raises WearcapError for a folder
    with anything else in it, for a recording without head poses, and for libraries that are missing or of another
    version than the lock's.
    """
    folder = Path(folder)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "network.json").is_file():
        raise WearcapError("a folder with other files", where=folder, expected="a new one, or a page's")
    require_libraries(libraries)
    with explaining_writes(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as made:
        out = Path(made) / "page"
        shutil.copytree(PAGE, out)
        for package, names in LIBRARIES.items():
            for name in names:
                (out / "libraries" / package / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(libraries / package / name, out / "libraries" / package / name)
        (graph,) = exports.graphs.values()
        report = export_network(graph, out / "network.onnx", "onnx", exports.max_error)
        about = {"wearcap_page": VERSION, "network": exports.network} | exports.about | constants()
        about |= {"sha256": sha256_of(out / "network.onnx"), "outputs": list(graph.inputs)}
        _write_json(out / "network.json", about)
        skeleton = convert(exports.about["skeleton"], SkeletonEntry).skeleton()
        write_glb(_resting(skeleton), out / "body.glb", anny_body(skeleton))
        _write_sample(recording, skeleton, out)
        _write_json(out / "files.json", _contents(out))
        with explaining_writes(folder):
            if folder.exists():
                folder.rename(Path(made) / "before")
            out.rename(folder)
    return replace(report, path=str(folder / "network.onnx"))


def constants() -> dict[str, Any]:
    """What a page needs to know beside the network: seats of devices, axes, limits of what people do."""
    T_aria_cpf = nominal_T_aria_cpf()
    seats = {
        family: {
            joint: {"R": _flat(wrist_of_hand(torch.eye(3)[None], joint, family)[0]), "t": _flat(palm_of(joint, family))}
            for joint in WRISTS
        }
        for family in SEATS
    }
    return {
        "seats": seats,
        "mount": _pose(T_HEAD_DEVICE),
        "aria": _pose(Rigid(T_aria_cpf.R @ R_CPF_DEVICE, T_aria_cpf.t)),
        "axes": {"openxr": _flat(OPENXR), "unity": _flat(UNITY)},
        "worlds": {name: _flat(R) for name, R in WORLDS.items()},
        "devices": {name: _flat(R) for name, R in DEVICES.items()},
        "upright_axis": UPRIGHT_AXIS,
        "floor_m": FLOOR_M,
        "heights_m": HEIGHTS_M,
        "carried": CARRIED,
        "upright": UPRIGHT,
        "upright_within_s": UPRIGHT_WITHIN_S,
        "look_frames": LOOK_FRAMES,
        "max_gap_s": MAX_GAP_S,
        "max_speed_m_s": MAX_SPEED_M_S,
        "max_turn_rad_s": MAX_TURN_RAD_S,
        "unseen_s": UNSEEN_S,
        "frozen_s": FROZEN_S,
    }


def locked() -> dict[str, dict[str, Any]]:
    """Entries of `LIBRARIES` in the lock of npm's packages: version, address and digest of each."""
    lock = read_json_object(resource("integrations/web", "web") / "package-lock.json")["packages"]
    return {package: lock[f"node_modules/{package}"] for package in LIBRARIES}


def require_libraries(folder: Path) -> None:
    """Raise WearcapError unless a folder of npm's packages holds those of the lock with all files that a page loads."""
    fix = "Run `npm ci` in integrations/web and give libraries=integrations/web/node_modules."
    for package, entry in locked().items():
        for name in ("package.json", *LIBRARIES[package]):
            if not (folder / package / name).is_file():
                raise WearcapError(f"no {package}/{name}", where=folder, expected="a node_modules folder", fix=fix)
        version, wanted = read_json_object(folder / package / "package.json")["version"], entry["version"]
        if version != wanted:
            raise WearcapError(f"{package} {version}", where=folder, expected=f"version {wanted}", fix=fix)


def fetched_libraries() -> Path:
    """A folder of the lock's packages, downloaded into the user's cache and verified. Raises WearcapError as `fetch` does."""
    entries = locked()
    folder = cache_folder() / "web" / content_hash(entries)
    for package, entry in entries.items():
        name = f"{package}-{entry['version']}.tgz"
        remote = Remote(name, (entry["resolved"],), entry["integrity"], MAX_TARBALL)
        names = ("package.json", *LIBRARIES[package])
        if all((folder / package / name).is_file() for name in names):
            continue
        archive = fetch(remote)
        damage = tarfile.TarError, LookupError
        with understood("not a package of npm", archive, "its files", errors=damage), tarfile.open(archive) as tar:
            for name in names:  # nothing else is read, and these are written under our own names
                content = tar.extractfile(f"package/{name}")
                assert content is not None
                with atomic_path(folder / package / name) as temporary:
                    temporary.write_bytes(content.read())
    return folder


def _write_sample(recording: Recording, fallback: Skeleton, out: Path) -> None:
    """sample.json with head and wrists, and sample.glb: the wearer's body, moving as the truth does where it is known.

    Wrists that were not tracked are the true ones, as controllers would give them.
    """
    head, motion = recording.head, recording.motion
    if head is None:
        raise WearcapError("no head poses in this recording", where=recording.name, expected="a `head` stream")
    end = head.timestamps[0].item() + MAX_SAMPLE_S
    count = int(torch.searchsorted(head.timestamps, end))
    if motion is not None:
        motion = motion.sliced(0, int(torch.searchsorted(motion.timestamps, end)))
    skeleton = recording.skeleton or (motion.skeleton if motion is not None else fallback)
    known = motion is not None and motion.skeleton.joint_names == skeleton.joint_names and len(motion) > 1
    wrists: dict[str, Any] = {}
    for joint in WRISTS:
        if (track := recording.tracked.get(joint)) is not None:
            seen = track.timestamps < end
            wrists[joint] = _path(track.timestamps[seen], Rigid(track.R_world_body[seen], track.t_world_body[seen]))
        elif known and motion is not None:
            at = motion.skeleton.index(joint)
            T = motion.T_world_joint
            wrists[joint] = _path(motion.timestamps, Rigid(T.R[:, at], T.t[:, at]))
    sample = {
        "name": recording.name,
        "source": recording.source,
        "license": recording.license,
        "truth": known,
        "start_s": head.timestamps[0].item(),
        "truth_start_s": motion.timestamps[0].item() if known and motion is not None else None,
        "head": _path(head.timestamps[:count], Rigid(head.R_world_device[:count], head.t_world_device[:count])),
        "mount": _pose(Rigid(head.R_head_device, head.t_head_device)),
        "wrists": wrists,
        "skeleton": _offsets(skeleton),
    }
    _write_json(out / "sample.json", sample)
    body: BodyModel = anny_body(skeleton, recording.shape or None)
    write_glb(motion if known and motion is not None else _resting(skeleton), out / "sample.glb", body)


def _resting(skeleton: Skeleton) -> Motion:
    """One frame of the rest pose, which stands on the floor."""
    R = torch.eye(3).repeat(1, len(skeleton), 1, 1)
    return Motion(torch.zeros(1).double(), skeleton, R, torch.tensor([[0.0, 0.0, skeleton.root_height]]))


def _contents(out: Path) -> dict[str, Any]:
    """Names of all files for the service worker, and a digest that changes when one of them does."""
    files = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    digest = hashlib.sha256("".join(sha256_of(out / name) for name in files).encode()).hexdigest()[:16]
    return {"version": digest, "files": files}


def _offsets(skeleton: Skeleton) -> dict[str, Any]:
    """The parts of a skeleton that a page takes from a recording: its joints' offsets and sites (m)."""
    return {
        "joint_names": skeleton.joint_names,
        "parents": skeleton.parents,
        "t_parent_joint": skeleton.t_parent_joint.tolist(),
        "sites": {name: [site.joint, *site.t_joint_site] for name, site in skeleton.sites.items()},
    }


def _path(timestamps: Tensor, T: Rigid) -> dict[str, Any]:
    """Poses over time, each as x, y, z (m) and a quaternion x, y, z, w."""
    xyzw = quat_wxyz_from_matrix(T.R.double()).roll(-1, dims=-1)
    poses = torch.cat([T.t.double(), xyzw], -1)
    return {"times": _rounded(timestamps), "poses": [_rounded(pose) for pose in poses]}


def _pose(T: Rigid) -> dict[str, list[float]]:
    return {"R": _flat(T.R), "t": _flat(T.t)}


def _flat(values: Tensor) -> list[float]:
    return values.double().flatten().tolist()


def _rounded(values: Tensor) -> list[float]:
    return [round(value, 6) for value in values.double().flatten().tolist()]


def _write_json(path: Path, tree: dict[str, Any]) -> None:
    path.write_text(json.dumps(tree, separators=(",", ":"), allow_nan=False), encoding="utf-8")
