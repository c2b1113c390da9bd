"""BEHAVE at 30 frames per second: a person and one of twenty objects, fitted to four depth cameras' pictures.

Folders as they unpack: `sequences/DATE_SUBJECT_OBJECT[_ACT]/` (or `behave-30fps-params-v1/…`) with `info.json`,
`smpl_fit_all.npz` and `object_fit_all.npz`, and `objects/OBJECT/` with the meshes. The world is the frame of one of the
cameras (x right, y down, z forward), which is mounted nearly level; the reader turns z up, and preparation removes the
camera's remaining tilt from the planted feet. Poses refer to a mesh whose vertices' mean is at the origin, and to exactly
the mesh that was registered: other resolutions of an object have another mean.
"""

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from wearcap.body.skeletons import smplh52
from wearcap.boundary.arrays import read_npz, require
from wearcap.boundary.opening import understood
from wearcap.boundary.texts import read_json
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.datasets.amass import PELVIS_SMPLH
from wearcap.io.datasets.one_object import OneObject
from wearcap.io.formats.ply import read_ply
from wearcap.io.formats.poses import check_rising
from wearcap.io.formats.smpl import shape_from_betas, smpl_motion
from wearcap.scene.objects import centered, check_object_mesh

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
