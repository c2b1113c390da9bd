"""Convert a captured motion to FBX by Blender, for programs that read neither USD nor glTF.

blender -b --python integrations/blender/to_fbx.py -- motion.glb motion.fbx

Writes armature, body and animation with one key per frame, at the motion's own rate. Of a .bvh file Blender's importer leaves
out the first frame and has no body, so only .glb is taken. Without Blender, an interpreter with `pip install bpy` runs it:
`python to_fbx.py motion.glb motion.fbx`.
"""

import json
import struct
import sys
from pathlib import Path

import bpy


def rate_of(glb: str) -> float:
    """Frame rate (Hz) of the first animation of a .glb file; 30 for a single frame."""
    with open(glb, "rb") as file:
        (size,) = struct.unpack_from("<I", file.read(20), 12)
        document = json.loads(file.read(size))
    times = document["accessors"][document["animations"][0]["samplers"][0]["input"]]
    seconds = times["max"][0] - times["min"][0]
    return round((times["count"] - 1) / seconds, 3) if seconds else 30.0


def convert(source: str, target: str) -> None:
    """Raises SystemExit for a file of another kind."""
    if Path(source).suffix.lower() != ".glb":
        raise SystemExit(f"{source}: no motion of a kind that is read. Expected a .glb file.")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, rate = bpy.context.scene, rate_of(source)
    scene.render.fps, scene.render.fps_base = max(1, round(rate)), max(1, round(rate)) / rate
    bpy.ops.import_scene.gltf(filepath=source, disable_bone_shape=True)
    spans = [action.frame_range for action in bpy.data.actions]
    scene.frame_start, scene.frame_end = (round(pick(edge)) for pick, edge in zip((min, max), zip(*spans)))
    bpy.ops.export_scene.fbx(
        filepath=target,
        object_types={"ARMATURE", "MESH", "EMPTY"},
        add_leaf_bones=False,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
    )


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if len(given) != 2:
        raise SystemExit(__doc__)
    convert(*given)
