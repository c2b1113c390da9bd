"""glTF: the file against the specification, its skinning and animation against forward kinematics, trimesh as a reader."""

import dataclasses
import json
import struct

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from tumbling_motion import blob, sample
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.io.formats.gltf import write_glb
from wearcap.recording import Motion

COMPONENTS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """A reader that trusts nothing: every rule it checks is one of the glTF 2.0 specification."""

    def __init__(self, content: bytes):
        magic, version, length = struct.unpack_from("<4sII", content)
        assert (magic, version, length) == (b"glTF", 2, len(content))
        size, kind = struct.unpack_from("<I4s", content, 12)
        assert kind == b"JSON"
        assert size % 4 == 0
        self.json = json.loads(content[20 : 20 + size])
        binary_size, kind = struct.unpack_from("<I4s", content, 20 + size)
        assert kind == b"BIN\0"
        assert binary_size % 4 == 0
        self.binary = content[28 + size :]
        assert len(self.binary) == binary_size
        assert 0 <= binary_size - self.json["buffers"][0]["byteLength"] < 4
        self.arrays = [self._array(accessor) for accessor in self.json["accessors"]]
        self._check_nodes()
        self._check_animation()
        self._check_mesh()

    def _array(self, accessor: dict) -> np.ndarray:
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTH[accessor["type"]]
        assert view["byteOffset"] % dtype.itemsize == 0
        assert view["byteOffset"] % 4 == 0
        assert accessor["count"] > 0
        assert accessor["count"] * width * dtype.itemsize == view["byteLength"]
        assert view["byteOffset"] + view["byteLength"] <= self.json["buffers"][0]["byteLength"]
        array = np.frombuffer(self.binary, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        if "min" in accessor:
            np.testing.assert_array_equal(accessor["min"], array.min(0))
            np.testing.assert_array_equal(accessor["max"], array.max(0))
        return array

    def _check_nodes(self) -> None:
        children = [child for node in self.json["nodes"] for child in node.get("children", [])]
        assert len(children) == len(set(children))
        assert not set(children) & set(self.json["scenes"][0]["nodes"])
        assert len(children) + len(self.json["scenes"][0]["nodes"]) == len(self.json["nodes"])
        for node in self.json["nodes"]:
            assert np.linalg.norm(node.get("rotation", [0, 0, 0, 1])) == pytest.approx(1, abs=1e-6)

    def _check_animation(self) -> None:
        (animation,) = self.json["animations"]
        targets = [(c["target"]["node"], c["target"]["path"]) for c in animation["channels"]]
        assert len(targets) == len(set(targets))
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times, values = self.arrays[sampler["input"]][:, 0], self.arrays[sampler["output"]]
            assert "min" in self.json["accessors"][sampler["input"]]
            assert times[0] >= 0
            assert (np.diff(times) > 0).all()
            assert len(times) == len(values)
            if channel["target"]["path"] == "rotation":
                np.testing.assert_allclose(np.linalg.norm(values, axis=-1), 1, atol=1e-6)
                assert ((values[1:] * values[:-1]).sum(-1) >= 0).all()

    def _check_mesh(self) -> None:
        (primitive,) = self.json["meshes"][0]["primitives"]
        self.mesh = {name: self.arrays[accessor] for name, accessor in primitive["attributes"].items()}
        self.faces = self.arrays[primitive["indices"]].reshape(-1, 3)
        assert "min" in self.json["accessors"][primitive["attributes"]["POSITION"]]
        assert len({len(array) for array in self.mesh.values()}) == 1
        assert self.faces.max() < len(self.mesh["POSITION"])
        np.testing.assert_allclose(self.mesh["WEIGHTS_0"].sum(-1), 1, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(self.mesh["NORMAL"], axis=-1), 1, atol=1e-5)
        assert (self.mesh["JOINTS_0"][self.mesh["WEIGHTS_0"] == 0] == 0).all()
        skin = self.json["skins"][0]
        assert self.mesh["JOINTS_0"].max() < len(skin["joints"])
        self.inverse_bind = self.arrays[skin["inverseBindMatrices"]].reshape(-1, 4, 4).transpose(0, 2, 1)
        assert len(self.inverse_bind) == len(skin["joints"])
        np.testing.assert_array_equal(self.inverse_bind[:, 3], np.tile([0, 0, 0, 1], (len(self.inverse_bind), 1)))

    def globals_at(self, time_s: float) -> dict[str, np.ndarray]:
        """World matrix of every node, as a viewer would show it at a time."""
        local = [
            (Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])), np.array(node.get("translation", [0.0, 0, 0])))
            for node in self.json["nodes"]
        ]
        animation = self.json["animations"][0]
        for channel in animation["channels"]:
            sampler, node = animation["samplers"][channel["sampler"]], channel["target"]["node"]
            times, values = self.arrays[sampler["input"]][:, 0], self.arrays[sampler["output"]]
            at = np.clip(time_s, times[0], times[-1])
            if channel["target"]["path"] == "rotation":
                local[node] = (Slerp(times, Rotation.from_quat(values))(at), local[node][1])
            else:
                local[node] = (local[node][0], np.array([np.interp(at, times, column) for column in values.T]))
        matrices: dict[str, np.ndarray] = {}

        def visit(node: int, above: np.ndarray) -> None:
            own = np.eye(4)
            own[:3, :3], own[:3, 3] = local[node][0].as_matrix(), local[node][1]
            matrices[self.json["nodes"][node]["name"]] = above @ own
            for child in self.json["nodes"][node].get("children", []):
                visit(child, above @ own)

        for node in self.json["scenes"][0]["nodes"]:
            visit(node, np.eye(4))
        return matrices

    def vertices_at(self, time_s: float) -> np.ndarray:
        """Skinned vertices, by the specification's formula."""
        matrices = self.globals_at(time_s)
        names = [self.json["nodes"][joint]["name"] for joint in self.json["skins"][0]["joints"]]
        joint = np.stack([matrices[name] for name in names]) @ self.inverse_bind
        points = np.concatenate([self.mesh["POSITION"], np.ones((len(self.mesh["POSITION"]), 1))], -1)
        posed = np.einsum("vkij,vj->vki", joint[self.mesh["JOINTS_0"]], points)[..., :3]
        return (self.mesh["WEIGHTS_0"][..., None] * posed).sum(1)


def to_y_up(points: np.ndarray) -> np.ndarray:
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)


def test_joints_stand_where_forward_kinematics_puts_them(tmp_path):
    motion = sample()
    write_glb(motion, tmp_path / "m.glb")
    glb = Glb((tmp_path / "m.glb").read_bytes())
    delay = 0.1  # the door's clock starts before the motion's
    for frame in (0, 3, 7):
        matrices = glb.globals_at(delay + frame / 30)
        for joint, name in enumerate(motion.skeleton.joint_names):
            expected = to_y_up(motion.T_world_joint.t[frame, joint].numpy())
            np.testing.assert_allclose(matrices[name][:3, 3], expected, atol=2e-5)
    np.testing.assert_allclose(
        glb.globals_at(0.2)["door"][:3, 3], to_y_up(motion.object_motion["door"].t_world_body[2].numpy()), atol=1e-5
    )
    assert glb.json["asset"]["extras"] == {"pipeline": "test"}


def test_skin_follows_linear_blend_skinning(tmp_path):
    motion = sample()
    body = blob(motion.skeleton)
    write_glb(motion, tmp_path / "m.glb", body)
    glb = Glb((tmp_path / "m.glb").read_bytes())
    pose = motion.T_world_joint[5]
    local = body.rest_vertices[:, None] - motion.skeleton.rest_joints[body.skin_joints]
    posed = (pose.R[body.skin_joints] @ local[..., None])[..., 0] + pose.t[body.skin_joints]
    expected = (body.skin_weights[..., None] * posed).sum(1).numpy()
    np.testing.assert_allclose(glb.vertices_at(0.1 + 5 / 30), to_y_up(expected), atol=5e-5)


def test_sticks_reach_from_joint_to_joint(tmp_path):
    motion = dataclasses.replace(sample(), object_motion=None)
    write_glb(motion, tmp_path / "m.glb")
    glb = Glb((tmp_path / "m.glb").read_bytes())
    vertices = glb.vertices_at(2 / 30)
    for name in ("left_knee", "right_wrist", "head"):
        joint = to_y_up(motion.joint(name).t[2].numpy())
        assert np.linalg.norm(vertices - joint, axis=-1).min() < 0.03  # a stick is 2.2 cm thick


def test_deviations_lie_in_the_animations_extras(tmp_path):
    motion = sample()
    write_glb(motion, tmp_path / "m.glb")
    assert "extras" not in Glb((tmp_path / "m.glb").read_bytes()).json["animations"][0]
    std = torch.rand(len(motion), len(motion.skeleton), generator=torch.Generator().manual_seed(2))
    write_glb(dataclasses.replace(motion, joint_std=std, joint_dof=2.5), tmp_path / "m.glb")
    found = Glb((tmp_path / "m.glb").read_bytes()).json["animations"][0]["extras"]
    assert found["joint_dof"] == 2.5
    rows = torch.tensor([found["joint_std_mm"][name] for name in motion.skeleton.joint_names]).T / 1000
    torch.testing.assert_close(rows, std, atol=5.1e-4, rtol=0)


def test_trimesh_opens_it(tmp_path):
    motion = sample()
    write_glb(motion, tmp_path / "m.glb", blob(motion.skeleton))
    scene = trimesh.load(tmp_path / "m.glb")
    assert {"left_wrist", "door", "z_up"} <= set(scene.graph.nodes)
    (mesh,) = scene.geometry.values()
    assert len(mesh.faces) == 60
    frame, _ = scene.graph.get("left_wrist")
    expected = to_y_up(motion.joint("left_wrist").t[0].numpy())
    np.testing.assert_allclose(frame[:3, 3], expected, atol=1e-5)


def test_one_frame_and_one_joint_are_enough(tmp_path):
    rod = Skeleton("rod", ("a",), (-1,), torch.zeros(1, 3))
    motion = Motion(torch.zeros(1, dtype=torch.float64), rod, torch.eye(3).expand(1, 1, 3, 3), torch.zeros(1, 3))
    write_glb(motion, tmp_path / "m.glb")
    Glb((tmp_path / "m.glb").read_bytes())


def test_what_cannot_be_shown_is_refused_and_leaves_nothing(tmp_path):
    motion = sample()
    bad = [
        motion.sliced(0, 0),
        dataclasses.replace(motion, t_world_root=motion.t_world_root * float("inf")),
        dataclasses.replace(motion, timestamps=motion.timestamps * 0),
    ]
    for broken in bad:
        with pytest.raises(WearcapError):
            write_glb(broken, tmp_path / "m.glb")
    with pytest.raises(WearcapError, match="rod"):
        write_glb(motion, tmp_path / "m.glb", blob(Skeleton("rod", ("a",), (-1,), torch.zeros(1, 3))))
    assert list(tmp_path.iterdir()) == []
