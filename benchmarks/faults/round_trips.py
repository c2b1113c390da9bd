"""Files that other programs read and write back: BVH through Blender, glb through Khronos' validator.

    python -m benchmarks.faults.round_trips MOTION.npz --blender PYTHON [--validator FOLDER]

PYTHON: an interpreter with `pip install bpy`. FOLDER: where `npm install gltf-validator` was run; needs node. Neither is a
dependency of wearcap. Prints the joints' distances (mm) after BVH → Blender → BVH, and the validator's counts.
"""

import argparse
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import wearcap
from wearcap.io.formats.motion_npz import read_motion
from wearcap.prepare.foreign import read_foreign_motion
from wearcap.recording import Motion

BLENDER = """
import sys, bpy
source, target, fps = sys.argv[-3:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = int(fps)
bpy.ops.import_anim.bvh(filepath=source, global_scale=1.0, rotate_mode='NATIVE', update_scene_duration=True)
bpy.ops.export_anim.bvh(filepath=target, global_scale=1.0, frame_start=bpy.context.scene.frame_start,
    frame_end=bpy.context.scene.frame_end, rotate_mode='NATIVE', root_transform_only=True)
"""
VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then(
    report => console.log(report.issues.numErrors, report.issues.numWarnings, report.issues.numInfos));
"""


def through_blender(motion: Motion, python: str, folder: Path) -> str:
    """Distances of all joints after the round trip."""
    wearcap.save(motion, folder / "ours.bvh")
    (folder / "run.py").write_text(BLENDER, encoding="utf-8")
    fps = str(round(motion.fps))
    subprocess.run(
        [python, folder / "run.py", folder / "ours.bvh", folder / "theirs.bvh", fps], check=True, capture_output=True
    )
    ours, theirs = (read_foreign_motion(folder / f"{name}.bvh").motion for name in ("ours", "theirs"))
    frames = min(len(ours), len(theirs))
    apart = (ours.T_world_joint.t[:frames] - theirs.T_world_joint.t[:frames]).norm(dim=-1)
    worst = ours.skeleton.joint_names[int(apart.amax(0).argmax())]
    return f"BVH through Blender: {len(ours)} frames out, {len(theirs)} back; {1000 * apart.mean():.2f} mm, worst {1000 * apart.max():.2f} ({worst})"


def validated(motion: Motion, modules: Path, folder: Path) -> str:
    """What Khronos' validator counts in a .glb."""
    wearcap.save(motion, folder / "ours.glb")
    run = subprocess.run(
        ["node", "-e", VALIDATE, folder / "ours.glb"], cwd=modules, check=True, capture_output=True, text=True
    )
    errors, warnings, infos = run.stdout.split()
    return f"glb: {errors} errors, {warnings} warnings, {infos} remarks"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motion", type=Path)
    parser.add_argument("--blender", help="interpreter with bpy")
    parser.add_argument("--validator", type=Path, help="folder with node_modules/gltf-validator")
    options = parser.parse_args()
    motion = read_motion(options.motion)
    with TemporaryDirectory() as folder:
        if options.blender:
            print(through_blender(motion, options.blender, Path(folder)))
        if options.validator:
            print(validated(motion, options.validator, Path(folder)))


if __name__ == "__main__":
    main()
