"""BEHAVE at 30 fps (sequences/, objects/): people handling one of twenty objects; bring your own download.

Folders as they unpack: `sequences/DATE_SUBJECT_OBJECT[_ACT]/` (or `behave-30fps-params-v1/…`) with `info.json`,
`smpl_fit_all.npz` and `object_fit_all.npz`, and `objects/OBJECT/` with the meshes. The world is the frame of one of the
cameras (x right, y down, z forward), which is mounted nearly level; the reader turns z up, and preparation removes the
camera's remaining tilt from the planted feet. Poses refer to a mesh whose vertices' mean is at the origin, and to exactly
the mesh that was registered: other resolutions of an object have another mean.
"""

import re
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from data_prep.one_object import VERSION, OneObject, one_object_recording
from data_prep.shared.engine import Splits, Task
from data_prep.shared.mocap import CleaningLimits, MocapSettings, foot_patches, on_xsens23
from wearcap.body.skeletons import smplh52
from wearcap.boundary.arrays import read_npz, require
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.files import content_hash
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.amass import PELVIS_SMPLH
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.poses import check_rising
from wearcap.io.formats.smpl import shape_from_betas, smpl_motion
from wearcap.scene.objects import centered, check_object_mesh

BEHAVE = MocapSettings(fps=30, limits=CleaningLimits(level_within=0.2))
"""Bodies were fitted frame by frame, so planted feet's heights spread further than in motion capture."""
FPS = 30
"""Frame rate (Hz) of the release that has `smpl_fit_all.npz`; the older release has one frame per second in folders."""
BODY_FILE, OBJECT_FILE, INFO_FILE = "smpl_fit_all.npz", "object_fit_all.npz", "info.json"
R_WORLD_CAMERA = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of the camera's axes (x right, y down, z forward) into x forward, y left, z up."""

_FOLDERS = ("sequences", "behave-30fps-params-v1")
_REGISTERED = {
    "chairblack": "chairblack_f2500.ply",
    "chairwood": "chairwood_f2500.ply",
    "monitor": "monitor_closed_f1000.ply",
    "tablesquare": "tablesquare_f2000.ply",
}
"""Files of the registered meshes; those of all other objects are OBJECT_f1000.ply."""
_OFF_GRID = 0.1
"""Largest distance (frames) of a time from a multiple of 1/30 s: times are rounded to milliseconds."""


def behave_folder(root: str | Path) -> Path:
    """The folder of sequences. Raises WearcapError where there is none with fits at 30 frames per second."""
    found = [Path(root) / name for name in _FOLDERS if _names(Path(root) / name)]
    if not found:
        fix = "Give BEHAVE's folder as source=DIR, with the parameters of all frames (30 fps) in it."
        raise WearcapError("no sequences", root, f"sequences/NAME/{BODY_FILE} and {OBJECT_FILE}", fix)
    return found[0]


def behave_names(root: str | Path) -> list[str]:
    """Names of all sequences with fits, in order. Raises WearcapError where there are none."""
    return _names(behave_folder(root))


def _names(folder: Path) -> list[str]:
    return sorted({path.parent.name for file in (BODY_FILE, OBJECT_FILE) for path in folder.glob(f"*/{file}")})


def read_behave(root: str | Path, name: str) -> OneObject:
    """Read one sequence: smplh52 and its object, z up, times as in the file (s); frames that were not fitted are gaps.

    Raises WearcapError for an unknown sequence, missing or damaged files, NaN, wrong shapes, body and object of
    different frames, times that are not 1/30 s apart, and for the mesh what `check_object_mesh` refuses.
    """
    if name not in behave_names(root):
        raise WearcapError(f"no sequence {name!r}", root, f"sequences/{name}/{BODY_FILE}")
    folder, parts = behave_folder(root) / name, name.split("_")
    if len(parts) < 3:
        expected = "a folder DATE_SUBJECT_OBJECT, such as Date01_Sub01_boxlarge_hand"
        raise WearcapError("not named as BEHAVE's are", folder, expected)
    body = read_npz(folder / BODY_FILE, ("poses", "trans", "betas", "frame_times"))
    fitted = read_npz(folder / OBJECT_FILE, ("angles", "trans", "frame_times"))
    frames = require(body, folder / BODY_FILE, poses=("time", 156), trans=("time", 3))["time"]
    require(fitted, folder / OBJECT_FILE, angles=("time", 3), trans=("time", 3))
    # Times (s) of the object's frames, which must equal the body's
    if not frames:
        raise WearcapError("no frames", folder / BODY_FILE, "poses of at least one frame")
    if len(fitted["angles"]) != frames:
        what = f"the object has {len(fitted['angles'])} frames, the body {frames}"
        raise WearcapError(what, folder, f"as many in {OBJECT_FILE} as in {BODY_FILE}", "Fetch both files again.")
    times = _times(fitted, folder / OBJECT_FILE, frames)
    if "frame_times" in body:
        other = _times(body, folder / BODY_FILE, frames)
        apart = np.flatnonzero(other != times)
        if len(apart):
            what = f"the body's frame {apart[0]} is of {other[apart[0]]:.3f} s, the object's of {times[apart[0]]:.3f} s"
            raise WearcapError(what, folder, "the same frame_times in both files", "Fetch both files again.")
    times = torch.from_numpy(times)
    info = read_json(folder / INFO_FILE)
    object_name = info.get("cat") if isinstance(info, dict) else None
    if not isinstance(object_name, str) or not object_name.isidentifier():
        expected = '{"cat": "boxlarge", "gender": "male", …}'
        raise WearcapError("does not name the object", folder / INFO_FILE, expected)
    gender = info["gender"] if isinstance(info.get("gender"), str) else ""
    pelvis, about = body["trans"].astype(np.float64) + PELVIS_SMPLH, {"source": name, "format": "behave"}
    motion = smpl_motion(times, smplh52(), body["poses"], pelvis, **about, gender=gender)
    R = rotation.exp(torch.from_numpy(fitted["angles"].astype(np.float64)))
    path = Trajectory(times, R.float(), torch.from_numpy(fitted["trans"].astype(np.float32)))
    take = OneObject(
        name,
        motion,
        object_name,
        path,
        read_behave_mesh(root, object_name),
        _shape(body, folder / BODY_FILE, frames),
        subject=parts[1],
        activity="_".join(parts[2:]),
        location=parts[0],
    )
    return take.turned(R_WORLD_CAMERA)


def read_behave_mesh(root: str | Path, object_name: str) -> Mesh:
    """Registered mesh of an object, centred on the mean of its vertices as the poses expect.

    Raises WearcapError where it is missing, and for what `check_object_mesh` refuses.
    """
    if not re.fullmatch(r"[\w-]{1,64}", object_name):
        raise WearcapError(f"an object named {object_name[:60]!r}", root, "one of BEHAVE's names, as boxlarge")
    path = Path(root) / "objects" / object_name / _REGISTERED.get(object_name, f"{object_name}_f1000.ply")
    if not path.is_file():
        fix = "Unpack BEHAVE's objects.zip beside the sequences."
        raise WearcapError(f"no mesh of {object_name}", path, "objects/OBJECT/OBJECT_f1000.ply", fix)
    mesh = read_ply(path).mesh
    if len(mesh.vertices):
        mesh, _ = centered(mesh)
    check_object_mesh(mesh, path)
    return mesh


def _times(arrays: dict[str, np.ndarray], path: Path, frames: int) -> Float64[np.ndarray, "time"]:
    """Times (s) from `frame_times` ("t0003.033"), snapped to whole frames. Raises WearcapError for rates other than 30."""
    stamps = arrays.get("frame_times")
    if stamps is None or stamps.shape != (frames,) or stamps.dtype.kind not in "US":
        what = f"frame_times is {'missing' if stamps is None else f'{stamps.dtype} {stamps.shape}'}"
        raise WearcapError(what, path, f'{frames} texts such as "t0003.033" (s)')
    texts = [text.decode("latin-1") if isinstance(text, bytes) else str(text) for text in stamps]
    with understood("frame_times cannot be read", path, 'texts such as "t0003.033" (s)'):
        seconds = np.array([float(text.removeprefix("t")) for text in texts])
    if not (np.abs(seconds) < 1e6).all():
        raise WearcapError("frame_times holds NaN or infinity", path, "seconds")
    grid = np.rint(seconds * FPS)
    step = float(np.median(np.diff(grid))) if frames > 1 else 1.0
    if np.abs(seconds * FPS - grid).max() > _OFF_GRID or step != 1.0:
        rate = 1 / max(float(np.median(np.abs(np.diff(seconds)))), 1e-6) if frames > 1 else 0.0
        fix = "Use the release of all frames (30 fps), not the one of one frame per second."
        raise WearcapError(f"frames come at {rate:.4g} per second", path, f"{FPS} per second", fix)
    check_rising(grid / FPS, path)
    return grid / FPS


def _shape(body: dict[str, np.ndarray], path: Path, frames: int) -> dict[str, float]:
    """The mean of the betas that were fitted frame by frame."""
    if "betas" not in body:
        return {}
    by_frame = body["betas"].ndim == 2
    require(body, path, betas=(frames, "feature") if by_frame else ("feature",))
    return shape_from_betas(body["betas"].mean(0) if by_frame else body["betas"])


MAX_TILT_DEG = 30.0
"""Largest tilt of the floor; beyond it the axes are not the documented ones."""


_KNOWN_WITHIN_M = 0.1
"""Spread (m, standard deviation) of foot positions at which half of the measured tilt is applied; nearly all if wider."""


_ROBUST_M = (1.0, 0.03)
"""Distance (m) from the floor at which a step has half weight, in the first and in the last iteration."""


_ROUNDS = 20


_MIN_STEPS = 10


def _ground_rotation(points_world: Float[Tensor, "point 3"]) -> Float[Tensor, "3 3"]:
    """Smallest rotation that levels the plane through positions of planted feet.

    The plane z = a·x + b·y + c is fitted robustly: points off it (feet on a step, on a chair's rung) lose their weight,
    and slopes are regularised towards 0 if the feet stayed in one place. Too few points give no rotation.
    """
    if len(points_world) < _MIN_STEPS:
        return torch.eye(3, dtype=points_world.dtype)
    points = points_world.double()
    weight = torch.ones(len(points), dtype=torch.float64)
    slope = torch.zeros(2, dtype=torch.float64)
    first, last = _ROBUST_M
    for step in range(_ROUNDS):
        share = (weight / weight.sum())[:, None]
        offset = points - (share * points).sum(0)
        plan, height = offset[:, :2], offset[:, 2]
        spread = plan.mT @ (share * plan) + _KNOWN_WITHIN_M**2 * torch.eye(2, dtype=torch.float64)
        slope = torch.linalg.solve(spread, plan.mT @ (share[:, 0] * height))
        scale = max(last, first * (last / first) ** (2 * step / _ROUNDS))
        weight = 1 / (1 + ((height - plan @ slope) / scale) ** 2)
    normal = torch.cat([-slope, torch.ones(1, dtype=torch.float64)])
    normal = normal / normal.norm()
    axis = torch.stack([normal[1], -normal[0], torch.zeros((), dtype=torch.float64)])
    angle = torch.arccos(normal[2].clamp(max=1.0))
    return rotation.exp(axis / axis.norm().clamp(min=1e-12) * angle).to(points_world.dtype)


def _level_behave(root: Path, name: str, settings: MocapSettings) -> OneObject:
    """A take, rotated so that the ground below the planted feet is level; provenance notes the tilt.

    Raises WearcapError for a ground tilted by more than `MAX_TILT_DEG`.
    """
    take = read_behave(root, name)
    motion = on_xsens23(take.motion)
    positions, speed = foot_patches(motion)
    R = _ground_rotation(positions[speed < settings.limits.contact_speed])
    tilt = float(torch.rad2deg(torch.arccos(R[2, 2].clamp(max=1.0))))
    if tilt > MAX_TILT_DEG:
        what = f"the ground below the feet is tilted by {tilt:.0f}°"
        fix = "Check which of the source's axes is up."
        raise WearcapError(what, where=take.name, expected=f"at most {MAX_TILT_DEG:g}°", fix=fix)
    motion = replace(motion, provenance=motion.provenance | {"tilt_deg": f"{tilt:.2f}"})
    return replace(take, motion=motion).turned(R)


def behave_tasks(
    source: str | Path,  # the folder that holds sequences (or behave-30fps-params-v1) and objects
    output: str | Path,
    splits: Splits,
    settings: MocapSettings = BEHAVE,
    license: str = "BEHAVE licence, non-commercial research (virtualhumans.mpi-inf.mpg.de/behave); not to be passed on",
) -> list[Task]:
    """One task per sequence of `source`; environments go to `output`/scenes. The split list's rows are sequences.

    Raises WearcapError without sequences.
    """
    source = Path(source)
    meshes = sorted(source.glob("objects/*/*_f*.ply"))
    shared = content_hash(asdict(settings), license, VERSION, *meshes)
    tasks, sequences = [], behave_folder(source)
    for name in behave_names(source):
        files = [sequences / name / file for file in (BODY_FILE, OBJECT_FILE, INFO_FILE)]
        key = content_hash(name, shared, *(file for file in files if file.is_file()))
        read = partial(_level_behave, source, name, settings)
        make = partial(one_object_recording, read, "BEHAVE", license, settings, Path(output))
        tasks.append(Task(name, make, splits.of(name), key))
    return tasks
