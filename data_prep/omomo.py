"""OMOMO (train_… and test_diffusion_manip_seq_joints24.p, captured_objects/): people handling one of fifteen objects; bring your own download.

`train_diffusion_manip_seq_joints24.p` and `test_…` are joblib files of {number: sequence}, read with the restricted
unpickler; `captured_objects/OBJECT_cleaned_simplified.obj` are the meshes. World: metres, z up. No file has the frame
rate. The root joint stands at `trans - trans2joint`. A vertex v of the file is at obj_scale · R · v + t: the meshes have
a unit and an origin of their own, so here they are scaled to metres, centred on the mean of their vertices, and their
paths are the centre's. Where an object's pose is missing its scale is 0. Of the two objects of two parts (mop, vacuum)
`obj_rot` and `obj_trans` are the upper part's; here the whole mesh moves with it.
"""

import hashlib
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from data_prep.one_object import VERSION, OneObject, one_object_recording
from data_prep.shared.engine import Splits, Task
from data_prep.shared.mocap import MocapSettings, foot_patches, on_xsens23
from wearcap.body.skeletons import smplx22
from wearcap.boundary.arrays import require
from wearcap.boundary.pickles import read_pickled_dict
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.amass import PELVIS_SMPLX
from wearcap.io.formats.poses import are_rotations
from wearcap.io.formats.smpl import shape_from_arrays, smpl_motion
from wearcap.io.formats.wavefront import read_obj
from wearcap.scene.objects import centered, check_object_mesh

OMOMO = MocapSettings(fps=30)
"""Faster files are brought to this rate, body and object alike."""
FILES = ("train_diffusion_manip_seq_joints24.p", "test_diffusion_manip_seq_joints24.p")
MESHES, MESH_ENDING = "captured_objects", "_cleaned_simplified.obj"
_TWO_PARTS = ("mop", "vacuum")

_KEYS = ("trans", "root_orient", "pose_body", "betas", "trans2joint", "obj_rot", "obj_trans", "obj_scale")
_LEAST_SCALE = 1e-8
_SCALE_WITHIN = 0.2
"""Largest relative variation of an object's scale within a sequence: objects are rigid."""
_ORTHOGONAL_WITHIN = 0.02


@dataclass(frozen=True, eq=False)
class OmomoSequence:
    """One sequence as stored; only its name has been checked."""

    name: str
    """Name SUBJECT_OBJECT_NUMBER, such as sub1_largebox_000."""
    where: str
    arrays: dict[str, np.ndarray]
    gender: str

    @property
    def subject(self) -> str:
        return self.name.split("_")[0]

    @property
    def object_name(self) -> str:
        return self.name.split("_")[1]


def read_omomo(root: str | Path) -> list[OmomoSequence]:
    """All sequences, by name, of the `FILES` that a folder contains.

    Raises WearcapError where there is none of them, for damaged files and for anything but arrays in them (which is
    never run), for what is no dict of sequences, and for sequences without a name such as sub1_largebox_000.
    """
    paths = [Path(root) / name for name in FILES if (Path(root) / name).is_file()]
    if not paths:
        raise WearcapError("no sequences", root, " or ".join(FILES), "Give OMOMO's folder as source=DIR.")
    found = []
    for path in paths:
        for key, entry in read_pickled_dict(path, "{number: {seq_name, trans, …}}").items():
            name = entry.get("seq_name") if isinstance(entry, dict) else None
            if not isinstance(name, str) or len(name.split("_")) < 3 or not name.replace("_", "").isalnum():
                expected = "seq_name SUBJECT_OBJECT_NUMBER, such as sub1_largebox_000"
                raise WearcapError(f"sequence {key!r} is named {name!r}"[:200], path, expected)
            arrays = {key: entry[key] for key in _KEYS if isinstance(entry.get(key), np.ndarray)}
            gender = entry.get("gender", "")
            if isinstance(gender, np.ndarray) and gender.size == 1:
                gender = gender.reshape(-1)[0]
            gender = str(gender) if isinstance(gender, str) else ""
            found.append(OmomoSequence(name, f"{path}, sequence {name}", arrays, gender))
    if not found:
        raise WearcapError("files without sequences", root, "{number: {seq_name, trans, …}}")
    return sorted(found, key=lambda sequence: sequence.name)


def omomo_mesh_path(root: str | Path, object_name: str) -> Path:
    """Path of an object's mesh."""
    return Path(root) / MESHES / f"{object_name}{MESH_ENDING}"


def omomo_take(sequence: OmomoSequence, root: str | Path, fps: float | int) -> OneObject:
    """One sequence as smplx22 with its object, from 0 s at `fps` (which no file has); frames without an object's pose
    are gaps.

    Raises WearcapError for missing arrays, wrong shapes, NaN, body and object of different lengths, rotations that are
    none, a scale that changes, a missing mesh, and for the mesh what `check_object_mesh` refuses.
    """
    where, arrays = sequence.where, _flat(sequence.arrays)
    require(arrays, where, trans=("time", 3), root_orient=("time", 3), pose_body=("time", 63))
    require(arrays, where, obj_rot=("frame", 3, 3), obj_trans=("frame", 3), obj_scale=("frame",))
    frames, others = len(arrays["trans"]), len(arrays["obj_trans"])
    if frames != others or not frames:
        what = f"the object has {others} frames, the body {frames}"
        raise WearcapError(what, where, "as many of both, and at least one", "Fetch the file again.")
    times = torch.arange(frames, dtype=torch.float64) / fps
    about = {"source": sequence.name, "format": "omomo", "gender": sequence.gender}
    if sequence.object_name in _TWO_PARTS:
        about["object"] = "of two parts, posed as its upper one"
    pelvis = arrays["trans"].astype(np.float64) + PELVIS_SMPLX
    if "trans2joint" in arrays:
        offset = {"trans2joint": arrays["trans2joint"].reshape(-1)}
        require(offset, where, trans2joint=(3,))
        pelvis = arrays["trans"].astype(np.float64) - offset["trans2joint"].astype(np.float64)
    rotvec = np.concatenate([arrays["root_orient"], arrays["pose_body"]], 1)
    motion = smpl_motion(times, smplx22(), rotvec, pelvis, **about)
    posed = arrays["obj_scale"] > _LEAST_SCALE
    mesh, center = _mesh(root, sequence.object_name, arrays["obj_scale"][posed], where)
    path = _path(arrays, times, torch.from_numpy(center), torch.from_numpy(posed), where)
    take = OneObject(
        sequence.name,
        motion,
        sequence.object_name,
        path,
        mesh,
        shape_from_arrays(arrays, where),
        sequence.subject,
        "_".join(sequence.name.split("_")[1:]),
    )
    return take.frames(torch.from_numpy(posed))


def _flat(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns where the public files have matrices of one column, and the body's joints as rows of numbers."""
    flat = dict(arrays)
    if "obj_trans" in flat and flat["obj_trans"].shape[1:] == (3, 1):
        flat["obj_trans"] = flat["obj_trans"][:, :, 0]
    if "pose_body" in flat and flat["pose_body"].shape[1:] == (21, 3):
        flat["pose_body"] = flat["pose_body"].reshape(-1, 63)
    return flat


def _mesh(root: str | Path, object_name: str, scales: np.ndarray, where: str) -> tuple[Mesh, Float64[np.ndarray, "3"]]:
    """The mesh in metres about its centre, and the centre in the file's axes and unit; `scales`: metres per unit."""
    if not len(scales):
        raise WearcapError("obj_scale is nowhere positive", where, "metres per unit of the mesh")
    scale = float(np.median(scales))
    if np.ptp(scales) > _SCALE_WITHIN * scale:
        what = f"obj_scale runs from {scales.min():.4g} to {scales.max():.4g}"
        raise WearcapError(what, where, f"one scale within {_SCALE_WITHIN:.0%}: a rigid object")
    path = omomo_mesh_path(root, object_name)
    if not path.is_file():
        fix = "Unpack OMOMO's captured_objects beside the sequences."
        raise WearcapError(f"no mesh of {object_name}", path, f"{MESHES}/OBJECT{MESH_ENDING}", fix)
    mesh, center = centered(read_obj(path))
    mesh = Mesh((mesh.vertices.astype(np.float64) * scale).astype(np.float32), mesh.faces, mesh.color)
    check_object_mesh(mesh, path)
    return mesh, center


def _path(arrays: dict[str, np.ndarray], times: Tensor, center: Tensor, posed: Tensor, where: str) -> Trajectory:
    """Trajectory of the mesh's centre: scale · R · c + t."""
    R = torch.from_numpy(arrays["obj_rot"].astype(np.float64))
    bad = ~are_rotations(R, _ORTHOGONAL_WITHIN) & posed
    if bad.any():
        what = f"obj_rot of frame {int(bad.nonzero()[0])} is no rotation ({int(bad.sum())} such frames)"
        raise WearcapError(what, where, "orthogonal matrices of determinant +1")
    U, _, Vh = torch.linalg.svd(torch.where(posed[:, None, None], R, torch.eye(3, dtype=R.dtype)))
    R = U @ Vh
    scale = torch.from_numpy(arrays["obj_scale"].astype(np.float64))
    t = torch.from_numpy(arrays["obj_trans"].astype(np.float64)) + scale[:, None] * (R @ center)
    return Trajectory(times, R.float(), t.float())


LOOKED_AT = 20
"""Number of evenly chosen sequences whose speeds are used to check the frame rate."""


FAST_PELVIS, FAST_FOOT = 2.5, 9.0
"""Speeds (m/s) that nobody carrying objects exceeds for long: 95th percentile of the pelvis, 99th of the toes."""


SLOW_PELVIS, SLOW_FOOT = 0.4, 1.2
"""Speeds (m/s) of pelvis and toes, one of which any walking person exceeds; a step lifts a foot at some 3 m/s."""


WALKED_M = 1.0
"""Least walked distance (m) of sequences from which too low a rate can be concluded."""


def omomo_tasks(
    source: str | Path,  # the folder that holds the .p files (one of them is enough) and captured_objects
    output: str | Path,
    splits: Splits,
    settings: MocapSettings = OMOMO,
    # not in the files; public loaders use 30 or 120; refused if people would not walk at human speeds
    source_fps: float | int = 30,
    license: str = "OMOMO, research use only (lijiaman.github.io/projects/omomo); not to be passed on",
) -> list[Task]:
    """One task per sequence of `source`'s files; environments go to `output`/scenes.

    `source_fps` is the frame rate, which the files lack. Raises WearcapError without sequences, for a rate that is no
    positive number, and for one at which the people would not move at human speeds.
    """
    source = Path(source)
    if not 0 < source_fps < 1e4:
        raise WearcapError(f"a frame rate of {source_fps} Hz", expected="source_fps=30 or another positive number")
    sequences = read_omomo(source)
    _check_rate(sequences, source, source_fps)
    shared = content_hash(asdict(settings), float(source_fps), license, VERSION)
    meshes = {sequence.object_name: omomo_mesh_path(source, sequence.object_name) for sequence in sequences}
    of_mesh = {name: content_hash(path) if path.is_file() else "" for name, path in meshes.items()}
    tasks = []
    for sequence in sequences:
        arrays = hashlib.sha256()  # of this sequence alone, so that changes of others do not make it out of date
        for name, array in sorted(sequence.arrays.items()):
            arrays.update(f"{name} {array.dtype} {array.shape}".encode())
            arrays.update(np.ascontiguousarray(array).tobytes())
        key = content_hash(sequence.name, shared, of_mesh[sequence.object_name], arrays.hexdigest())
        read = partial(omomo_take, sequence, source, source_fps)
        make = partial(one_object_recording, read, "OMOMO", license, settings, Path(output))
        tasks.append(Task(sequence.name, make, splits.of(sequence.subject), key))
    return tasks


def _check_rate(sequences: list[OmomoSequence], root: str | Path, fps: float | int) -> None:
    """Raise WearcapError if, at this frame rate, people would run all the time or walk in slow motion.

    The check uses medians over `LOOKED_AT` sequences of the speeds over ground of the pelvis (95th percentile) and of
    the faster toes (99th); unreadable sequences are reported by their own tasks.
    """
    speeds = []
    for index in sorted({int(k) for k in np.linspace(0, len(sequences) - 1, LOOKED_AT)}):
        try:
            motion = omomo_take(sequences[index], root, fps).motion
        except WearcapError:
            continue
        if len(motion) > 2:
            motion = on_xsens23(motion)
            steps = motion.t_world_root[:, :2].diff(dim=0).norm(dim=-1)
            speed = torch.quantile(steps / motion.timestamps.diff().to(steps.dtype), 0.95)
            toes = torch.quantile(foot_patches(motion)[1].amax(1), 0.99)
            speeds.append((float(speed), float(toes), float(steps.sum())))
    if not speeds:
        return
    pelvis, foot, walked = np.median(np.array(speeds), axis=0)
    fast = pelvis > FAST_PELVIS or foot > FAST_FOOT
    slow = walked > WALKED_M and pelvis < SLOW_PELVIS and foot < SLOW_FOOT
    if fast or slow:
        raise WearcapError(
            f"at {fps:g} frames per second people walk at {pelvis:.2f} m/s and swing their feet at {foot:.2f} m/s",
            where=root,
            expected="some 1 and 3 m/s",
            fix=f"The true rate is {'lower' if fast else 'higher'} (public loaders use 30 or 120): give it as source_fps=….",
        )
