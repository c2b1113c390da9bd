"""Armatures with our joints as bones, and motions as their keyframes: with B the bone's rest rotation, L becomes B^T L B."""

import bpy
import numpy as np
from mathutils import Matrix, Vector

from .motion_file import quaternions

SHORTEST_M, LEAST_M = 0.02, 1e-4
"""Length of bones without a joint or an end below them, and the least shift of a joint that becomes keyframes."""


def add(context, motion, name):
    """A new armature with a motion, which gives the scene its frame rate and length."""
    made = build(context, motion, name)
    if len(motion.times) > 1:
        hz, render = 1 / np.median(np.diff(motion.times)), context.scene.render
        render.fps = max(1, round(hz))
        render.fps_base = render.fps / hz if abs(render.fps - hz) > 1e-3 * hz else 1.0
        context.scene.frame_end = int(np.ceil(frames_of(context, motion.times[-1] - motion.times[0])))
    animate(context, made, motion, name)
    return made


def build(context, motion, name):
    """A new armature in the scene, its bones at the rest pose with the root at the origin."""
    armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    context.collection.objects.link(armature)
    context.view_layer.objects.active = armature
    rest = [np.zeros(3)]
    for joint in range(1, len(motion.names)):
        rest.append(rest[motion.parents[joint]] + motion.offsets[joint])
    ends = dict(sorted(motion.ends.values(), key=lambda end: np.linalg.norm(end[1])))  # the farthest of each joint
    bpy.ops.object.mode_set(mode="EDIT")
    bones = []
    for joint, label in enumerate(motion.names):
        below = [rest[k] for k, parent in enumerate(motion.parents) if parent == joint]
        tail = np.mean(below, 0) if below else rest[joint] + ends.get(label, np.zeros(3))
        if np.linalg.norm(tail - rest[joint]) < SHORTEST_M:
            tail = rest[joint] + np.array([0.0, 0.0, SHORTEST_M])
        bone = armature.data.edit_bones.new(label)
        bone.head, bone.tail = Vector(rest[joint]), Vector(tail)
        if motion.parents[joint] >= 0:
            bone.parent = bones[motion.parents[joint]]
        bones.append(bone)
    bpy.ops.object.mode_set(mode="OBJECT")
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"
    return armature


def posed(armature, motion, frames=slice(None)):
    """Rotations (time joint 3 3) and locations (time joint 3) of the bones in their own axes."""
    bones = [armature.data.bones[name] for name in motion.names]
    B = np.array([np.array(bone.matrix_local)[:3, :3] for bone in bones])
    moves = np.zeros((*motion.R[frames].shape[:2], 3)) if motion.shifts is None else motion.shifts[frames].copy()
    moves[:, 0] = motion.t[frames] - np.array(bones[0].head_local)
    return B.swapaxes(-1, -2) @ motion.R[frames] @ B, (B.swapaxes(-1, -2) @ moves[..., None])[..., 0]


def show(armature, motion):
    """Put the armature into a motion's last frame, by bones of the same names."""
    (local,), (moves,) = posed(armature, motion, slice(-1, None))
    for name, matrix, move in zip(motion.names, local, moves):
        bone = armature.pose.bones[name]
        bone.rotation_quaternion, bone.location = Matrix(matrix.tolist()).to_quaternion(), Vector(move)


def animate(context, armature, motion, action_name):
    """Keyframes of a motion on an armature, and of its objects on empties, at the scene's frame rate."""
    R, moves = posed(armature, motion)
    local = quaternions(R)
    at = frames_of(context, motion.times - motion.times[0])
    curves = new_curves(armature, action_name)
    for joint, name in enumerate(motion.names):
        path = f'pose.bones["{bpy.utils.escape_identifier(name)}"]'
        write_curves(curves, f"{path}.rotation_quaternion", at, local[:, joint])
        if joint == 0 or np.abs(moves[:, joint]).max() > LEAST_M:
            write_curves(curves, f"{path}.location", at, moves[:, joint])
    for name, track in motion.objects.items():
        if not len(track.times):
            continue
        moved = bpy.data.objects.new(name, None)
        context.collection.objects.link(moved)
        moved.rotation_mode, moved.empty_display_type, moved.empty_display_size = "QUATERNION", "ARROWS", 0.2
        own = new_curves(moved, f"{action_name} {name}")
        own_at = frames_of(context, track.times - motion.times[0])
        write_curves(own, "location", own_at, track.t)
        write_curves(own, "rotation_quaternion", own_at, quaternions(track.R))


def frames_of(context, seconds):
    """Frames of the scene at times after its first frame."""
    return context.scene.frame_start + seconds * context.scene.render.fps / context.scene.render.fps_base


def new_curves(owner, name):
    """The F-curves of a new action of an object."""
    action = bpy.data.actions.new(name)
    owner.animation_data_create().action = action
    if not hasattr(action, "slots"):  # Blender before 4.4
        return action.fcurves
    slot = action.slots.new(owner.id_type, owner.name)
    owner.animation_data.action_slot = slot
    return action.layers.new("Layer").strips.new(type="KEYFRAME").channelbag(slot, ensure=True).fcurves


def write_curves(curves, path, frames, values):
    """Keyframes of a property: one curve for each column of the values."""
    for index, column in enumerate(values.T):
        curve = curves.new(path, index=index)
        curve.keyframe_points.add(len(frames))
        curve.keyframe_points.foreach_set("co", np.stack([frames, column], -1).astype(np.float32).ravel())
        linear = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items["LINEAR"].value
        curve.keyframe_points.foreach_set("interpolation", np.full(len(frames), linear, np.int32))
        curve.update()
