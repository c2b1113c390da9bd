"""VRM animation: the file parsed on its own against forward kinematics, and, where node's packages are, three-vrm's player
and Khronos' validator.

`WEARCAP_NODE_MODULES` is a folder made by `npm install three @pixiv/three-vrm @pixiv/three-vrm-animation gltf-validator`.
"""

import json
import os
import shutil
import struct
import subprocess
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import wearcap
from tumbling_motion import sample
from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.body.skeletons import cmu31, smpl24, smplh52
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion

NODE_MODULES = os.environ.get("WEARCAP_NODE_MODULES", "")
needs_node = pytest.mark.skipif(not NODE_MODULES or not shutil.which("node"), reason="needs WEARCAP_NODE_MODULES")
LIMBS = {
    "UpperLeg": "hip",
    "LowerLeg": "knee",
    "Foot": "ankle",
    "UpperArm": "shoulder",
    "LowerArm": "elbow",
    "Hand": "wrist",
}
JOINTS = {"hips": "pelvis", "neck": "neck", "head": "head"} | {
    f"{side}{bone}": f"{side}_{joint}" for side in ("left", "right") for bone, joint in LIMBS.items()
}
"""Joints of the named skeletons of which a bone has exactly the place."""
SPINES = {
    "xsens23": {"spine": "l5", "upperChest": "t8"},
    "smpl24": {"spine": "spine1", "chest": "spine2", "upperChest": "spine3"},
    "smplh52": {
        "leftIndexDistal": "left_index3",
        "rightThumbMetacarpal": "right_thumb1",
        "leftLittleProximal": "left_pinky1",
    },
}
REQUIRED = {"hips", "spine", "head"} | {f"{side}{bone}" for side in ("left", "right") for bone in LIMBS}
NAMED = (xsens23, smpl24, smplh52)


def bending(skeleton: Skeleton, frames: int = 12) -> Motion:
    """Random poses of all joints within some 30°, on a path."""
    generator = torch.Generator().manual_seed(3)
    R = rotation.exp(0.25 * torch.randn(frames, len(skeleton), 3, generator=generator))
    path = torch.randn(frames, 3, generator=generator)
    return Motion(torch.arange(frames, dtype=torch.float64) / 30 + 5, skeleton, R, path)


def to_vrm(points: np.ndarray) -> np.ndarray:
    """Of x forward, y left, z up: x left, y up, z forward."""
    return points[..., [1, 2, 0]]


class Vrma:
    """The file's nodes, keys and bones, read as glTF and the extension's specification define them."""

    def __init__(self, path: Path):
        content = path.read_bytes()
        (size,) = struct.unpack_from("<I", content, 12)
        self.json, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
        extension = self.json["extensions"]["VRMC_vrm_animation"]
        assert self.json["extensionsUsed"] == ["VRMC_vrm_animation"]
        assert extension["specVersion"] == "1.0"
        self.bones = {name: bone["node"] for name, bone in extension["humanoid"]["humanBones"].items()}
        nodes = self.json["nodes"]
        assert not any("rotation" in node or "scale" in node or "matrix" in node for node in nodes)
        self.parents = {child: node for node, row in enumerate(nodes) for child in row.get("children", [])}
        assert set(self.parents) | {0} == set(range(len(nodes)))
        self.rest = np.array([node["translation"] for node in nodes])
        self.keys = {}
        (animation,) = self.json["animations"]
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            arrays = []
            for index in (sampler["input"], sampler["output"]):
                accessor = self.json["accessors"][index]
                start = self.json["bufferViews"][accessor["bufferView"]]["byteOffset"]
                width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
                arrays.append(np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width))
            self.keys[target["node"], target["path"]] = arrays
        assert {node for node, path in self.keys if path == "translation"} == {self.bones["hips"]}
        self.times = self.keys[0, "translation"][0][:, 0]

    def places(self, frame: int | None) -> dict[str, np.ndarray]:
        """World positions of the bones in a frame, or at rest."""
        R, t = {}, {}
        for node in sorted(self.bones.values()):  # parents come first
            parent = self.parents.get(node)
            turn = Rotation.identity() if frame is None else Rotation.from_quat(self.keys[node, "rotation"][1][frame])
            if parent is None:
                R[node], t[node] = turn, self.rest[node] if frame is None else self.keys[node, "translation"][1][frame]
            else:
                R[node], t[node] = R[parent] * turn, t[parent] + R[parent].apply(self.rest[node])
        return {name: t[node] for name, node in self.bones.items()}


@pytest.mark.parametrize("make", NAMED)
def test_bones_stand_where_forward_kinematics_puts_the_joints(tmp_path, make):
    motion = bending(make())
    wearcap.save(motion, tmp_path / "m.vrma")
    file = Vrma(tmp_path / "m.vrma")
    np.testing.assert_allclose(file.times, (motion.timestamps - motion.timestamps[0]).numpy(), atol=1e-6)
    checked = JOINTS | SPINES[motion.skeleton.name]
    assert set(checked) <= set(file.bones)
    for frame in range(len(motion)):
        places = file.places(frame)
        for bone, joint in checked.items():
            expected = to_vrm(motion.joint(joint).t[frame].numpy())
            np.testing.assert_allclose(places[bone], expected, atol=2e-5)


@pytest.mark.parametrize("make", [*NAMED, cmu31])
def test_the_rest_pose_is_vrms(tmp_path, make):
    """Standing on y = 0, facing +z, arms along x; all bones that VRM requires."""
    wearcap.save(bending(make()), tmp_path / "m.vrma")
    file = Vrma(tmp_path / "m.vrma")
    rest = file.places(None)
    assert set(file.bones) >= REQUIRED
    for side, out in (("left", 1), ("right", -1)):
        arm = [rest[f"{side}{bone}"] for bone in ("UpperArm", "LowerArm", "Hand")]
        for one, other in pairwise(arm):
            np.testing.assert_allclose((other - one) / np.linalg.norm(other - one), [out, 0, 0], atol=1e-6)
        assert rest[f"{side}Toes"][2] > rest[f"{side}Foot"][2] + 0.05
        assert 0 <= rest[f"{side}Toes"][1] < rest[f"{side}Foot"][1] < 0.15
    assert rest["head"][1] > rest["hips"][1] > 0.8
    assert rest["hips"][0] == pytest.approx(0, abs=1e-6)


def test_a_foreign_skeleton_keeps_its_limbs(tmp_path):
    """A bind pose that is no T-pose, and joints without a bone of VRM: arms and legs point where they pointed."""
    motion = bending(cmu31())
    wearcap.save(motion, tmp_path / "m.vrma")
    file, pairs = Vrma(tmp_path / "m.vrma"), {"UpperLeg LowerLeg": "femur tibia", "UpperArm LowerArm": "humerus radius"}
    for frame in (0, 11):
        places = file.places(frame)
        for bones, joints in pairs.items():
            for side in ("left", "right"):
                start, end = (places[f"{side}{bone}"] for bone in bones.split())
                ours = [to_vrm(motion.joint(f"{side[0]}{joint}").t[frame].numpy()) for joint in joints.split()]
                np.testing.assert_allclose(end - start, ours[1] - ours[0], atol=1e-5)


def test_what_is_no_body_is_refused_and_leaves_nothing(tmp_path):
    rod = Skeleton("rod", ("a",), (-1,), torch.zeros(1, 3))
    still = Motion(torch.zeros(1, dtype=torch.float64), rod, torch.eye(3).expand(1, 1, 3, 3), torch.zeros(1, 3))
    for motion in (still, replace(sample(), t_world_root=sample().t_world_root * float("inf"))):
        with pytest.raises(WearcapError):
            wearcap.save(motion, tmp_path / "m.vrma")
    assert list(tmp_path.iterdir()) == []


def node(script: Path, *arguments: Path | str) -> dict:
    (script.parent / "node_modules").symlink_to(NODE_MODULES)
    done = subprocess.run(["node", script, *arguments], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@needs_node
@pytest.mark.parametrize("make", NAMED)
def test_three_vrm_plays_it(tmp_path, make):
    """On an avatar of the same size, whose bones have random axes."""
    motion = bending(make())
    wearcap.save(motion, tmp_path / "m.vrma")
    file = Vrma(tmp_path / "m.vrma")
    rest, names = file.places(None), {node: name for name, node in file.bones.items()}
    turns = Rotation.random(len(names), random_state=5).as_quat()
    bones = [
        {
            "name": name,
            "parent": names.get(file.parents.get(node)),
            "place": rest[name].tolist(),
            "turn": turns[node].tolist(),
        }
        for node, name in sorted(names.items())
    ]
    (tmp_path / "humanoid.json").write_text(json.dumps({"bones": bones, "times": file.times[:-1].tolist()}))
    script = shutil.copy(Path(__file__).with_name("play_vrma.mjs"), tmp_path)
    played = node(Path(script), tmp_path / "m.vrma", tmp_path / "humanoid.json")
    assert played["tracks"] == len(bones) + 1
    assert played["duration"] == pytest.approx(file.times[-1], abs=1e-6)
    checked = JOINTS | SPINES[motion.skeleton.name]
    for frame, places in enumerate(played["places"]):
        for bone, joint in checked.items():
            np.testing.assert_allclose(places[bone], to_vrm(motion.joint(joint).t[frame].numpy()), atol=1e-3)


@needs_node
def test_khronos_validator_finds_nothing(tmp_path):
    wearcap.save(bending(smplh52()), tmp_path / "m.vrma")
    script = tmp_path / "validate.cjs"
    script.write_text(
        "const v = require('gltf-validator'), fs = require('fs');\n"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])))"
        ".then(r => console.log(JSON.stringify(r.issues)));\n"
    )
    issues = node(script, tmp_path / "m.vrma")
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues
    assert {issue["code"] for issue in issues["messages"]} <= {"UNSUPPORTED_EXTENSION", "NODE_EMPTY"}
