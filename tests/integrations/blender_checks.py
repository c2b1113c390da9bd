"""Run inside Blender's Python (bpy), without wearcap: what tests/integrations/test_blender.py asks for, as JSON.

python blender_checks.py ADDON_FOLDER WHAT ARGUMENTS …
"""

import json
import sys
import time

import bpy
import numpy as np

sys.path.insert(0, sys.argv[1])
import wearcap_blender
from wearcap_blender import armature, capture, live


def heads(made, frames):
    """World places of the bones' heads by name at frames of the scene."""
    found = {}
    for frame in frames:
        bpy.context.scene.frame_set(int(frame), subframe=float(frame) % 1)
        shown = made.evaluated_get(bpy.context.evaluated_depsgraph_get())
        for bone in shown.pose.bones:
            found.setdefault(bone.name, []).append(list(shown.matrix_world @ bone.head))
    return found


def imported(path, times):
    assert bpy.ops.wearcap.import_motion(filepath=path) == {"FINISHED"}
    made = bpy.context.object
    frames = armature.frames_of(bpy.context, np.array(json.loads(times)))
    found = {"bones": heads(made, frames), "fps": bpy.context.scene.render.fps / bpy.context.scene.render.fps_base}
    found["end"] = bpy.context.scene.frame_end
    objects = [each for each in bpy.data.objects if each.type == "EMPTY"]
    bpy.context.scene.frame_set(1)
    found["objects"] = {each.name: [list(row) for row in each.matrix_world] for each in objects}
    return found


def received(port, count, seconds):
    """Frames come from a sender that starts once the port is printed; the armature follows, then all of it is baked."""
    receiver = live.start("127.0.0.1", int(port))
    print(f"PORT {receiver.port}", flush=True)
    until = time.monotonic() + float(seconds)
    while len(receiver.frames) < int(count) and time.monotonic() < until:
        assert live.tick() is not None
        time.sleep(0.005)
    shown = bpy.data.objects[receiver.object_name]
    bpy.context.view_layer.update()
    found = {"refused": receiver.reader.refused, "frames": len(receiver.frames)}
    found["live"] = {bone.name: list(bone.head) for bone in shown.pose.bones}
    found["times"] = [each[0] for each in receiver.frames]
    assert bpy.ops.wearcap.live_stop() == {"FINISHED"}
    assert bpy.ops.wearcap.live_bake() == {"FINISHED"}
    times = np.array(found["times"]) - found["times"][0]
    found["baked"] = heads(bpy.context.object, armature.frames_of(bpy.context, times))
    return found


def captured(command, recording, output, more, cancel_after):
    run = capture.Run(command, recording, output, more)
    start = time.monotonic()
    while run.poll() is None:
        time.sleep(0.05)
        if float(cancel_after) and time.monotonic() - start > float(cancel_after):
            run.cancel()
    found = {"done": run.poll(), "lines": list(run.lines), "canceled": run.canceled}
    if found["done"]:
        found["bones"] = len(capture.import_motion(bpy.context, run.output / "motion.npz").pose.bones)
    return found


def refused(*paths):
    found = {}
    for path in paths:
        try:
            found[path] = str(bpy.ops.wearcap.import_motion(filepath=path))
        except RuntimeError as error:  # an operator's report
            found[path] = str(error)
    return found


if __name__ == "__main__":
    bpy.ops.wm.read_factory_settings(use_empty=True)
    wearcap_blender.register()
    answer = globals()[sys.argv[2]](*sys.argv[3:])
    wearcap_blender.unregister()
    print("ANSWER " + json.dumps(answer), flush=True)
