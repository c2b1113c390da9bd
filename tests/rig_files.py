"""Characters written by hand: a .glb named as Mixamo's in a T-pose, a VRM 0 in an A-pose with names of its own, both with a mesh.

Independent of the package. Bones have axes, units and proportions of their own; feet stand on y = 0.
"""

import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

ROWS = (
    ("Hips", "", (0, 0.95, 0)), ("Spine", "Hips", (0, 0.10, -0.01)), ("Spine1", "Spine", (0, 0.12, 0)),
    ("Spine2", "Spine1", (0, 0.13, 0)), ("Neck", "Spine2", (0, 0.16, 0.01)), ("Head", "Neck", (0, 0.10, 0.02)),
    ("LeftShoulder", "Spine2", (0.05, 0.11, 0)), ("LeftArm", "LeftShoulder", (0.12, 0, 0)),
    ("LeftForeArm", "LeftArm", (0.26, 0, 0)), ("LeftHand", "LeftForeArm", (0.25, 0, 0)),
    ("LeftHandIndex1", "LeftHand", (0.09, 0, 0.02)),
    ("LeftUpLeg", "Hips", (0.09, -0.05, 0)), ("LeftLeg", "LeftUpLeg", (0, -0.42, 0)), ("LeftFoot", "LeftLeg", (0, -0.40, 0)),
    ("LeftToeBase", "LeftFoot", (0, -0.06, 0.13)), ("LeftToe_End", "LeftToeBase", (0, -0.015, 0.07)),
)  # fmt: skip
"""Joints of the T-pose (m): x to the character's left, y up, z ahead; the right side is mirrored."""
VRM = dict(zip(
    ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot",
     "ToeBase"),
    ("hips", "spine", "chest", "upperChest", "neck", "head", "Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg",
     "LowerLeg", "Foot", "Toes")))  # fmt: skip
SOLE = 0.025
"""Height of the toes' ends over the mesh's lowest vertex (m)."""


def joints() -> list[tuple[str, str, np.ndarray]]:
    rows = [(name, parent, np.array(offset, float)) for name, parent, offset in ROWS]
    mirror = np.array([-1.0, 1, 1])
    return rows + [
        (n.replace("Left", "Right"), p.replace("Left", "Right"), mirror * o) for n, p, o in rows if "Left" in n
    ]


def packed(arrays: list[np.ndarray]) -> tuple[bytes, list[dict], list[dict]]:
    """A buffer of vertices, joints, weights, matrices and indices, with its views and accessors."""
    binary, views = b"", []
    for array in arrays:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes})
        binary += array.tobytes() + b"\0" * (-array.nbytes % 4)
    kinds = [(5126, "VEC3"), (5121, "VEC4"), (5126, "VEC4"), (5126, "MAT4"), (5123, "SCALAR")]
    accessors = [
        {"bufferView": k, "componentType": c, "count": len(a), "type": t}
        for k, (a, (c, t)) in enumerate(zip(arrays, kinds))
    ]
    return binary, views, accessors


def humanoid(number: dict[str, int]) -> list[dict]:
    """VRM's bones of the nodes by their names."""
    bones = []
    for name, k in number.items():
        side, part = (
            ("left", name[4:]) if name[:4] == "Left" else ("right", name[5:]) if name[:5] == "Right" else ("", name)
        )
        if part in VRM:
            bones.append({"bone": side + VRM[part], "node": k, "useDefaultValues": True})
    return bones


def glb(document: dict, binary: bytes) -> bytes:
    """A .glb file of its JSON and its buffer."""
    text = json.dumps(document, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    whole = (
        struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary)) + struct.pack("<I4s", len(text), b"JSON") + text
    )
    return whole + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def bone_nodes(rows: list, own: list[Rotation], place: list[np.ndarray], vrm: bool, scale: float) -> list[dict]:
    """Nodes of bones with these rotations and places in the world."""
    number, nodes = {name: k for k, (name, _, _) in enumerate(rows)}, list[dict]()
    for k, (name, parent, _) in enumerate(rows):
        R_above, t_above = (
            (own[number[parent]], place[number[parent]]) if parent else (Rotation.identity(), np.zeros(3))
        )
        local = R_above.inv() * own[k]
        nodes.append({
            "name": f"bone{k * 7 % 29}" if vrm else f"mixamorig:{name}",
            "translation": (R_above.inv().apply(place[k] - t_above) * scale).tolist(),
            "rotation": local.as_quat().tolist(),
            "children": [number[n] for n, p, _ in rows if p == name],
        })  # fmt: skip
        if not nodes[-1]["children"]:
            del nodes[-1]["children"]
    return nodes


def write(path: Path, vrm: bool, size: float = 1.0) -> dict:
    """Write a character; `vrm` faces -z, is A-posed and has nameless names. Returns its JSON."""
    rows, scale = joints(), 100.0 if not vrm else 1.0
    face = Rotation.from_euler("y", 180 if vrm else 0, degrees=True)
    rng = np.random.default_rng(5)
    number = {name: k for k, (name, _, _) in enumerate(rows)}
    world: list[tuple[Rotation, np.ndarray]] = []
    down = Rotation.identity()
    for name, parent, offset in rows:
        bend = {"LeftArm": -45, "RightArm": 45}.get(name, 0) if vrm else 0
        above_pose, above = (down, np.zeros(3)) if not parent else world[number[parent]]
        pose = Rotation.from_euler("z", bend, degrees=True) * above_pose
        world.append((pose, above + above_pose.apply(offset * size)))
    own = [face * Rotation.from_rotvec(0 * rng.normal(size=3) if vrm else rng.normal(size=3)) for _ in rows]
    place = [face.apply(t) for _, t in world]
    nodes = bone_nodes(rows, own, place, vrm, scale)
    low = min(t[1] for t in place) - SOLE * size
    vertices = np.array([*place, [0.05, low, 0.1], [0.05, low, 0.2], [0.1, low, 0.1]], "<f4")
    joint = np.zeros((len(vertices), 4), "u1")
    joint[:, 0] = [*range(len(rows)), *[number["LeftFoot"]] * 3]
    weights = np.tile(np.array([1, 0, 0, 0], "<f4"), (len(vertices), 1))
    bind = np.stack([np.eye(4)] * len(rows))
    for k in range(len(rows)):
        bind[k, :3, :3], bind[k, :3, 3] = own[k].as_matrix().T / 1.0, -own[k].inv().apply(place[k])
        bind[k, :3] *= scale  # joints of a figure in centimetres undo its scale
    arrays = [
        vertices,
        joint,
        weights,
        bind.swapaxes(1, 2).astype("<f4"),
        np.arange(len(vertices) // 3 * 3, dtype="<u2"),
    ]
    binary, views, accessors = packed(arrays)
    accessors[0] |= {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
    top, figure = len(nodes), len(nodes) + 1
    armature = {"name": "Armature", "children": [0], "scale": [1 / scale] * 3}
    primitive = {"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 4, "material": 0}
    document = {
        "asset": {"version": "2.0", "generator": "by hand", "extras": {"kept": [1, 2.5, "ü"]}},
        "scene": 0, "scenes": [{"nodes": [top, figure]}],
        "nodes": [*nodes, armature, {"name": "Head", "mesh": 0, "skin": 0}],
        "meshes": [{"name": "body", "primitives": [primitive], "weights": [0.5]}],
        "materials": [{"name": "cloth", "extensions": {"KHR_materials_unlit": {}}}],
        "skins": [{"joints": list(range(len(rows))), "inverseBindMatrices": 3, "skeleton": 0}],
        "animations": [{"name": "idle", "samplers": [], "channels": []}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary), "name": "all"}],
        "extensionsUsed": ["KHR_materials_unlit"],
    }  # fmt: skip
    if vrm:
        document["extensions"] = {
            "VRM": {"specVersion": "0.0", "humanoid": {"humanBones": humanoid(number)}, "meta": {"title": "own"}}
        }
        document["extensionsUsed"].append("VRM")
    path.write_bytes(glb(document, binary))
    return document


class Played:
    """An animated .glb, played by the glTF specification alone: world places (m) of the nodes at the animation's times."""

    def __init__(self, path: Path):
        data = path.read_bytes()
        (size,) = struct.unpack_from("<I", data, 12)
        self.json = json.loads(data[20 : 20 + size])
        self.binary = data[28 + size :]
        self.named = {node["name"]: k for k, node in enumerate(self.json["nodes"])}
        self.animation = self.json["animations"][0]
        inputs = {sampler["input"] for sampler in self.animation["samplers"]}
        assert len(inputs) == 1
        self.times = self.array(inputs.pop())
        self.parents = {child: k for k, node in enumerate(self.json["nodes"]) for child in node.get("children", [])}
        self.world: dict[int, np.ndarray] = {}

    def array(self, number: int) -> np.ndarray:
        accessor = self.json["accessors"][number]
        view = self.json["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(self.binary, "<f4", accessor["count"] * width, view["byteOffset"])
        return values.reshape(-1, width) if width > 1 else values

    def track(self, node: int, path: str) -> np.ndarray | None:
        found = [c for c in self.animation["channels"] if c["target"] == {"node": node, "path": path}]
        return self.array(self.animation["samplers"][found[0]["sampler"]]["output"]) if found else None

    def matrices(self, node: int) -> np.ndarray:
        """Poses "time 4 4" of a node in the world."""
        if node not in self.world:
            of, frames = self.json["nodes"][node], len(self.times)
            t, q = (self.track(node, path) for path in ("translation", "rotation"))
            T = np.tile(np.eye(4), (frames, 1, 1))
            R = Rotation.from_quat(
                np.tile(of.get("rotation", [0, 0, 0, 1]), (frames, 1)) if q is None else q
            ).as_matrix()
            T[:, :3, :3] = R * np.array(of.get("scale", [1, 1, 1]))
            T[:, :3, 3] = of.get("translation", [0, 0, 0]) if t is None else t
            self.world[node] = self.matrices(self.parents[node]) @ T if node in self.parents else T
        return self.world[node]
