"""The body, and objects, to Unity, Unreal, Blender, VSeeFace and others by the VMC protocol (OSC over UDP, port 39539).

A receiver gets `/VMC/Ext/Root/Pos` and a `/VMC/Ext/Bone/Pos` for each of Unity's humanoid bones (fingers' where they are captured):
position and rotation relative to the parent bone, in Unity's axes (left-handed, x right, y up, z forward, metres), of a T-pose
without rotations.
Objects are trackers: a `/VMC/Ext/Tra/Pos` with the object's name, position and rotation (x y z w) in the world, for each
that has a pose in the frame. Their own axes are turned like the world's: a mesh's x forward, y left, z up are Unity's z, -x, y.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float
from torch import Tensor

from wearcap.apps.live.sinks.objects import objects_of
from wearcap.apps.live.sinks.udp import Message, UdpSink, osc_bundle
from wearcap.body.hands import has_fingers
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.io.devices.axes import UNITY
from wearcap.recording import Motion

_SIDES = {
    "Shoulder": "collar",
    "UpperArm": "shoulder",
    "LowerArm": "elbow",
    "Hand": "wrist",
    "UpperLeg": "hip",
    "LowerLeg": "knee",
    "Foot": "ankle",
    "Toes": "toe",
}
BONES = {
    "Hips": "pelvis",
    "Spine": "l3",
    "Chest": "t12",
    "UpperChest": "t8",
    "Neck": "neck",
    "Head": "head",
    **{f"{side}{bone}": f"{side.lower()}_{joint}" for side in ("Left", "Right") for bone, joint in _SIDES.items()},
}
"""Unity's names of bones, parents first, with our joints; the lowest of the spine's joints has no bone of its own."""
_UNITY_FINGERS = {"Thumb": "thumb", "Index": "index", "Middle": "middle", "Ring": "ring", "Little": "pinky"}
FINGER_BONES = {
    f"{side}{name}{bone}": f"{side.lower()}_{finger}{k}"
    for side in ("Left", "Right")
    for name, finger in _UNITY_FINGERS.items()
    for k, bone in enumerate(("Proximal", "Intermediate", "Distal"), 1)
}
"""The same of fingers, for skeletons that have them."""
PARENTS = {
    "Hips": None,
    "Spine": "Hips", "Chest": "Spine", "UpperChest": "Chest", "Neck": "UpperChest", "Head": "Neck",
    **{f"{side}{bone}": f"{side}{parent}" for side in ("Left", "Right") for bone, parent in (
        ("UpperArm", "Shoulder"), ("LowerArm", "UpperArm"), ("Hand", "LowerArm"),
        ("LowerLeg", "UpperLeg"), ("Foot", "LowerLeg"), ("Toes", "Foot"))},
    **{f"{side}Shoulder": "UpperChest" for side in ("Left", "Right")},
    **{f"{side}UpperLeg": "Hips" for side in ("Left", "Right")},
    **{f"{side}{name}{bone}": f"{side}{parent.format(name)}" for side in ("Left", "Right") for name in _UNITY_FINGERS
       for bone, parent in (("Proximal", "Hand"), ("Intermediate", "{}Proximal"), ("Distal", "{}Intermediate"))},
}  # fmt: skip
"""Parent of each bone; None of the hips."""
_CALIBRATED = 3
"""Of `/VMC/Ext/OK`: the performer is calibrated."""


class VmcSink(UdpSink):
    """Sends one wearer's body: the one that the address names (`?wearer=NAME`), else the first that comes."""

    port = 39539
    convention = "Unity's humanoid bones, objects as trackers; left-handed, y up, z forward, metres"
    joints = tuple(BONES.values())

    def datagrams(self, motion: Motion, origin_s: float) -> Iterator[bytes]:
        (positions, rotations), objects = bones_of(motion), objects_of(motion)
        for k, time_s in enumerate(motion.timestamps.tolist()):
            trackers = {name: seen.T_world_object for name, seen in objects[k].items()}
            yield bundle(positions[k], rotations[k], time_s - origin_s, trackers)


def bones_of(motion: Motion) -> tuple[Float[Tensor, "time bone 3"], Float[Tensor, "time bone 4"]]:
    """Position and rotation (xyzw) of each of the skeleton's bones relative to its parent, the hips' in the world, in
    Unity's axes."""
    bones = BONES | (FINGER_BONES if has_fingers(motion.skeleton) else {})
    names = list(bones)
    pose = motion.T_world_joint[:, motion.skeleton.indices(*bones.values())]
    R, t = UNITY.mT @ pose.R @ UNITY, pose.t @ UNITY
    parents = [names.index(PARENTS[name]) for name in names[1:]]
    t_local, R_local = t.clone(), R.clone()
    t_local[:, 1:] = (R[:, parents].mT @ (t[:, 1:] - t[:, parents])[..., None])[..., 0]
    R_local[:, 1:] = R[:, parents].mT @ R[:, 1:]
    return t_local, quat_wxyz_from_matrix(R_local.double()).float().roll(-1, -1)


def bundle(
    t: Float[Tensor, "bone 3"], xyzw: Float[Tensor, "bone 4"], time_s: float, trackers: Mapping[str, Rigid]
) -> bytes:
    """One frame as an OSC bundle; `trackers`: poses by name in wearcap's world."""
    messages: list[Message] = [
        ("/VMC/Ext/OK", 1, _CALIBRATED, 0),
        ("/VMC/Ext/T", float(np.float32(time_s))),
        ("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    ]
    for name, place, turn in zip(BONES | FINGER_BONES, t.tolist(), xyzw.tolist()):
        messages.append(("/VMC/Ext/Bone/Pos", name, *place, *turn))
    for name, pose in trackers.items():
        turn = quat_wxyz_from_matrix((UNITY.mT @ pose.R @ UNITY).double()).roll(-1)
        messages.append(("/VMC/Ext/Tra/Pos", name, *(pose.t @ UNITY).tolist(), *turn.tolist()))
    return osc_bundle(messages)
