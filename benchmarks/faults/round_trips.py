"""Motions in every format, read back by other programs: how far joints and times are from what was captured.

    python -m benchmarks.faults.round_trips MOTION.npz … --blender PYTHON [--validator FOLDER]

PYTHON: an interpreter with `pip install bpy`. FOLDER: where `npm install gltf-validator` was run; needs node. Neither is a
dependency of wearcap. Blender reads BVH, glb, USD and VRM animation, and usd-core USD's skeleton; NumPy and SciPy read the
others, with forward kinematics that owes nothing to wearcap's. Ten frames of a motion are compared. Exits with 1 where a
joint is off by 1 mm or a time by 1 ms.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

import wearcap
from wearcap.body.skeleton import SIDES
from wearcap.body.skeletons import smplh52
from wearcap.io.formats.motion_npz import read_motion
from wearcap.io.saving import on_skeleton
from wearcap.recording import Motion

BY_BLENDER = (".bvh", ".glb", ".usdc", ".vrma")
Places = Mapping[str, np.ndarray]
"""Joints' places (frame, 3) in the world (m, z up) by the file's names."""
Row = tuple[str, str, int, float, float | None]
"""Format, reader, number of joints found, worst distance (mm; a validator's: number of errors), worst time (ms)."""
_LIMB = {
    "UpperLeg": "hip",
    "LowerLeg": "knee",
    "Foot": "ankle",
    "Toes": "toe",
    "UpperArm": "shoulder",
    "LowerArm": "elbow",
    "Hand": "wrist",
}
OF_VRM = {"hips": "pelvis", "head": "head"} | {
    f"{side}{vrm}": f"{side}_{ours}" for side in SIDES for vrm, ours in _LIMB.items()
}

BLENDER = """
import json, sys, bpy
files, fps, frames = json.loads(sys.argv[-1])
found = {}
for path in files:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, kind = bpy.context.scene, path.rsplit('.', 1)[1]
    scene.render.fps, scene.render.fps_base = round(fps), round(fps) / fps
    if kind == 'bvh':
        bpy.ops.import_anim.bvh(filepath=path, global_scale=0.01, frame_start=1, rotate_mode='NATIVE')
    elif kind == 'usdc':
        bpy.ops.wm.usd_import(filepath=path, set_frame_range=False)
    else:
        copy = path + '.glb'
        open(copy, 'wb').write(open(path, 'rb').read())
        bpy.ops.import_scene.gltf(filepath=copy)
    places = found[kind] = {}
    for frame in frames:
        scene.frame_set(frame + (kind == 'bvh'))
        for each in scene.objects:
            places.setdefault(each.name, []).append(list(each.matrix_world.translation))
            for bone in each.pose.bones if each.pose else ():
                places.setdefault(bone.name, []).append(list(each.matrix_world @ bone.head))
print('FOUND' + json.dumps(found))
"""
VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then(
    report => console.log(report.issues.numErrors, report.issues.numWarnings, report.issues.numInfos));
"""


def by_blender(motion: Motion, folder: Path, python: str, frames: list[int]) -> dict[str, Places]:
    """What Blender reads of `BY_BLENDER`, by ending."""
    asked = json.dumps([[str(folder / f"m{ending}") for ending in BY_BLENDER], motion.fps, frames])
    (folder / "run.py").write_text(BLENDER, encoding="utf-8")
    run = subprocess.run([python, folder / "run.py", asked], check=True, capture_output=True, text=True)
    (line,) = (line for line in run.stdout.splitlines() if line.startswith("FOUND"))
    found = json.loads(line.removeprefix("FOUND"))
    return {f".{kind}": {name: np.array(at) for name, at in places.items()} for kind, places in found.items()}


def posed(rotations: np.ndarray, root: np.ndarray, parents: list[int], offsets: np.ndarray) -> np.ndarray:
    """Forward kinematics by SciPy: places (frame, joint, 3) of rotations (frame, joint, 3, 3) to the parents."""
    turns, places = [Rotation.from_matrix(rotations[:, 0])], [root]
    for joint, parent in list(enumerate(parents))[1:]:
        places.append(places[parent] + turns[parent].apply(offsets[joint]))
        turns.append(turns[parent] * Rotation.from_matrix(rotations[:, joint]))
    return np.stack(places, 1)


def from_npz(folder: Path, frames: list[int]) -> Places:
    with np.load(folder / "m.npz") as file:
        skeleton = json.loads(str(file["wearcap"]))["motion"]["skeleton"]
        rotations, root = (file[name][frames].astype(float) for name in ("R_parent_joint", "t_world_root"))
        places = posed(rotations, root, skeleton["parents"]["$tuple"], file["skeleton.t_parent_joint"])
        return {str(name): places[:, k] for k, name in enumerate(file["joint_names"])}


def from_usd(folder: Path, frames: list[int]) -> Places:
    """By UsdSkel, as Unreal and Omniverse do."""
    stage, cache = Usd.Stage.Open(str(folder / "m.usdc")), UsdSkel.Cache()
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/motion/figure/skeleton"))
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/motion/figure")), Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(skeleton)
    codes = stage.GetPrimAtPath("/motion/figure/skeleton/animation").GetAttribute("rotations").GetTimeSamples()
    at = [np.array(query.ComputeJointWorldTransforms(UsdGeom.XformCache(codes[k])))[:, 3, :3] for k in frames]
    names = [path.rsplit("/", 1)[-1] for path in query.GetJointOrder()]
    return {name: np.stack([each[k] for each in at]) for k, name in enumerate(names)}


def from_trc(folder: Path, frames: list[int]) -> Places:
    """Metres of a TRC's columns, y up in the file."""
    lines = (folder / "m.trc").read_text(encoding="utf-8").splitlines()
    names, unit = lines[3].split("\t")[2::3], {"m": 1.0, "mm": 1e-3}[lines[2].split("\t")[4]]
    rows = np.array([[float(each) for each in line.split("\t")] for line in lines[5:] if line.strip()])
    at = unit * rows[frames, 2:].reshape(len(frames), -1, 3)[..., [0, 2, 1]] * [1, -1, 1]
    return {name: at[:, k] for k, name in enumerate(filter(None, names))}


def from_amass(motion: Motion, folder: Path, frames: list[int]) -> tuple[Places, Places]:
    """Places that SMPL+H's parameters give on the mean body's bones, and those that they ought to give."""
    skeleton = smplh52()
    ours = on_skeleton(motion, skeleton).T_world_joint.t[frames].double().numpy()
    with np.load(folder / "m_smplh.npz") as file:
        R = Rotation.from_rotvec(file["poses"][frames].reshape(-1, 3)).as_matrix().reshape(len(frames), -1, 3, 3)
        pelvis = file["trans"][frames] + [
            -0.0022,
            -0.2408,
            0.0286,
        ]  # of SMPL+H's mean body, in its axes: y up, z forward
    places = posed(R, pelvis, list(skeleton.parents), skeleton.t_parent_joint.numpy()[:, [1, 2, 0]])
    names = skeleton.joint_names
    return {n: places[:, k] for k, n in enumerate(names)}, {n: ours[:, k] for k, n in enumerate(names)}


def times_of(folder: Path, ending: str) -> np.ndarray | None:
    """Times (s) of a file's frames, as the file states them; None for what Blender alone reads."""
    path = folder / f"m{ending}"
    if ending == ".npz":
        return np.load(path)["timestamps"]
    if ending == ".bvh":
        lines = path.read_text(encoding="utf-8").splitlines()
        first = next(k for k, line in enumerate(lines) if line.startswith("Frame Time"))
        return float(lines[first].split(":")[1]) * np.arange(len(lines) - first - 1)
    if ending == ".usdc":
        stage = Usd.Stage.Open(str(path))
        codes = stage.GetPrimAtPath("/motion/figure/skeleton/animation").GetAttribute("rotations").GetTimeSamples()
        return np.array(codes) / stage.GetTimeCodesPerSecond()
    if ending in (".trc", ".mot", "_angles.csv"):
        text = path.read_text(encoding="utf-8").splitlines()
        rows = [line.replace(",", " ").split() for line in text if line[:1].isdigit() or line[:1] == "-"]
        rows = [row for row in rows if len(row) > 8]
        return np.array([float(row[ending == ".trc"]) for row in rows])
    return None


def apart_mm(found: Places, ours: Places) -> tuple[int, float]:
    """Number of joints that the file has by our names, and the largest distance of one (mm)."""
    names = [name for name in ours if name in found]
    return len(names), max((1e3 * np.abs(found[name] - ours[name]).max() for name in names), default=float("nan"))


def rows_of(motion: Motion, folder: Path, blender: str | None, validator: Path | None) -> list[Row]:
    """One motion in every format."""
    for ending in (*BY_BLENDER, ".npz", "_smplh.npz", ".trc", ".mot", "_angles.csv"):
        wearcap.save(motion, folder / f"m{ending}")
    frames = np.linspace(0, len(motion) - 1, 10).round().astype(int).tolist()
    at = motion.T_world_joint.t[frames].double().numpy()
    ours = {name: at[:, k] for k, name in enumerate(motion.skeleton.joint_names)}
    rows = [
        (".npz", "NumPy", *apart_mm(from_npz(folder, frames), ours)),
        (".usdc", "usd-core", *apart_mm(from_usd(folder, frames), ours)),
        (".trc", "NumPy", *apart_mm(from_trc(folder, frames), ours)),
        ("_smplh.npz", "SciPy", *apart_mm(*from_amass(motion, folder, frames))),
        *((ending, "NumPy", 0, 0.0) for ending in (".mot", "_angles.csv")),
    ]
    if blender:
        for ending, found in by_blender(motion, folder, blender, frames).items():
            rows.append((ending, "Blender", *apart_mm(by_our_names(found, ending), ours)))
    checked = [(*row, time_error_ms(motion, folder, row[0])) for row in rows]
    for ending in (".glb", ".vrma") if validator else ():
        run = ["node", "-e", VALIDATE, folder / f"m{ending}"]
        counts = subprocess.run(run, cwd=validator, check=True, capture_output=True, text=True).stdout.split()
        checked.append((ending, "gltf-validator", 0, float(counts[0]), None))
    return checked


def time_error_ms(motion: Motion, folder: Path, ending: str) -> float | None:
    """Largest error of the frames' times, the first of which may be 0 in the file."""
    if (times := times_of(folder, ending)) is None:
        return None
    ours = motion.timestamps.numpy()
    if len(times) != len(ours):
        return float("inf")
    return 1e3 * np.abs((times - times[0]) - (ours - ours[0])).max()


def by_our_names(found: Places, ending: str) -> Places:
    """What Blender has in its axes, by our joints' names; those of BVH and VRM animation face along -y there."""
    if ending not in (".bvh", ".vrma"):
        return found
    return {OF_VRM.get(name, name): np.stack([-at[:, 1], at[:, 0], at[:, 2]], -1) for name, at in found.items()}


def shown(motions: Mapping[str, list[Row]]) -> Table:
    """A row for each format and reader, a column for each motion."""
    table = Table("format", "reader", *motions)
    for rows in zip(*motions.values()):
        cells = []
        for _, reader, joints, worst, late_ms in rows:
            what = (
                f"{worst:.0f} errors"
                if "validator" in reader
                else f"{joints} joints, {worst:.3f} mm"
                if joints
                else "read"
            )
            cells.append(what + ("" if late_ms is None else f", {late_ms:.2g} ms"))
        table.add_row(rows[0][0], rows[0][1], *cells)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", type=Path, nargs="+")
    parser.add_argument("--blender", help="interpreter with bpy")
    parser.add_argument("--validator", type=Path, help="folder with node_modules/gltf-validator")
    options, found = parser.parse_args(), {}
    for path in options.motions:
        with TemporaryDirectory() as folder:
            found[str(path.parent.name)] = rows_of(read_motion(path), Path(folder), options.blender, options.validator)
    Console(width=60 + 34 * len(found)).print(shown(found))
    bad = [row for rows in found.values() for row in rows if not row[3] < 1.0 or not (row[4] or 0.0) < 1.0]
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
