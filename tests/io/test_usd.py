"""USD: its own validators, and its own skeletons and skinning against forward kinematics and linear blend skinning."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import wearcap
from tumbling_motion import blob, sample
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.io.saving import usd_writer
from wearcap.recording import Motion
from wearcap.scene.objects import Environment, Freedom, SceneObject

ENDINGS = (".usd", ".usda", ".usdz")
TETRAHEDRON = Mesh(
    np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.int32([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
    np.float32([0.8, 0.2, 0.1]),
)


def rich() -> Motion:
    """A door, estimates, and frames that are not evenly spaced."""
    motion, generator = sample(9), torch.Generator().manual_seed(7)
    estimates = {"contact_prob": 4, "joint_std": len(motion.skeleton)}
    values = {name: torch.rand(9, size, generator=generator) for name, size in estimates.items()}
    timestamps = motion.timestamps.clone()
    timestamps[5:] += 0.0141
    return replace(motion, timestamps=timestamps, **values)


def surroundings() -> tuple[Environment, Mesh]:
    """The door's mesh, and a cloud as a scan."""
    door = SceneObject("door", "door", TETRAHEDRON, torch.eye(3), torch.zeros(3), Freedom("free"))
    points = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    return Environment((door,)), Mesh(points, np.zeros((0, 3), np.int32), np.abs(points) % 1)


def findings(stage) -> list[str]:
    validation = pytest.importorskip("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    return [error.GetMessage() for error in validation.ValidationContext(validators).Validate(stage)]


def posed(stage, code: float):
    """Joints' transforms ("joint 4 4", columns) and the body's vertices at a time code, as USD computes them."""
    from pxr import Usd, UsdGeom, UsdSkel

    cache = UsdSkel.Cache()
    root = UsdSkel.Root(stage.GetPrimAtPath("/motion/figure"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/motion/figure/skeleton")))
    joints = np.array(skeleton.ComputeJointWorldTransforms(UsdGeom.XformCache(code))).transpose(0, 2, 1)
    body = stage.GetPrimAtPath("/motion/figure/body")
    points = UsdGeom.Mesh(body).GetPointsAttr().Get()
    transforms = skeleton.ComputeSkinningTransforms(code)
    assert cache.GetSkinningQuery(body).ComputeSkinnedPoints(transforms, points, code)
    return joints, np.array(points)


@pytest.mark.parametrize("ending", ENDINGS)
def test_usd_computes_the_joints_and_the_skin_that_we_do(tmp_path, ending):
    Usd = pytest.importorskip("pxr.Usd")
    motion = rich()
    body = blob(motion.skeleton)
    usd_writer()(motion, tmp_path / f"m{ending}", body, *surroundings())
    stage = Usd.Stage.Open(str(tmp_path / f"m{ending}"))
    assert findings(stage) == []
    rate = stage.GetTimeCodesPerSecond()
    animation = stage.GetPrimAtPath("/motion/figure/skeleton/animation")
    codes = animation.GetAttribute("rotations").GetTimeSamples()
    start_s = stage.GetRootLayer().customLayerData["wearcap"]["start_s"]
    np.testing.assert_allclose(np.array(codes) / rate + start_s, motion.timestamps, atol=1e-9, rtol=0)
    assert codes[:5] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (codes[0], codes[-1])
    vertices = body.vertices(motion.T_world_joint)
    low, high = stage.GetPrimAtPath("/motion/figure").GetAttribute("extent").Get()
    for frame in (0, 4, 8):
        joints, points = posed(stage, codes[frame])
        np.testing.assert_allclose(joints[:, :3, 3], motion.T_world_joint.t[frame], atol=2e-5)
        np.testing.assert_allclose(joints[:, :3, :3], motion.T_world_joint.R[frame], atol=2e-5)
        np.testing.assert_allclose(points, vertices[frame], atol=5e-5)
        assert (points >= np.array(low)).all()
        assert (points <= np.array(high)).all()


@pytest.mark.parametrize("ending", ENDINGS)
def test_objects_scan_and_estimates_are_there(tmp_path, ending):
    Usd, UsdGeom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    motion, (environment, scan) = rich(), surroundings()
    usd_writer()(motion, tmp_path / f"m{ending}", None, environment, scan)
    assert len(list(tmp_path.iterdir())) == (1 if ending == ".usdz" else 2)
    stage = Usd.Stage.Open(str(tmp_path / f"m{ending}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    door, rate = motion.object_motion["door"], stage.GetTimeCodesPerSecond()
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/motion/objects/door/surface"))
    np.testing.assert_array_equal(surface.GetPointsAttr().Get(), TETRAHEDRON.vertices)
    code = (door.timestamps[2] - motion.timestamps[0]).item() * rate
    place = np.array(surface.ComputeLocalToWorldTransform(code)).T
    np.testing.assert_allclose(place[:3, :3], door.R_world_body[2], atol=1e-5)
    np.testing.assert_allclose(place[:3, 3], door.t_world_body[2], atol=1e-5)
    cloud = UsdGeom.Points(stage.GetPrimAtPath("/motion/scan/surface"))
    np.testing.assert_array_equal(cloud.GetPointsAttr().Get(), scan.vertices)
    np.testing.assert_array_equal(cloud.GetDisplayColorAttr().Get(), scan.color)
    figure = stage.GetPrimAtPath("/motion/figure")
    for name in ("contact_prob", "joint_std"):
        np.testing.assert_array_equal(figure.GetAttribute(f"wearcap:{name}").Get(3.0), getattr(motion, name)[3])
    assert list(figure.GetAttribute("wearcap:joint_std:parts").Get()) == list(motion.skeleton.joint_names)


def test_names_that_usd_does_not_take_and_a_single_frame(tmp_path):
    Usd, UsdSkel = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdSkel")
    names = ("mixamorig:Hips", "a b", "a.b", "7")
    rod = Skeleton("rod", names, (-1, 0, 0, 2), torch.tensor([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1.0]]))
    R = torch.eye(3).expand(1, 4, 3, 3)
    motion = Motion(torch.zeros(1, dtype=torch.float64), rod, R, torch.tensor([[0.0, 0.0, 2.0]]))
    usd_writer()(motion, tmp_path / "m.usda")
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    assert findings(stage) == []
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/motion/figure/skeleton"))
    assert tuple(skeleton.GetJointNamesAttr().Get()) == names
    np.testing.assert_allclose(posed(stage, 0.0)[0][:, :3, 3], motion.T_world_joint.t[0])


def test_the_validators_find_what_is_wrong():
    Usd = pytest.importorskip("pxr.Usd")
    stage = Usd.Stage.CreateInMemory()
    stage.DefinePrim("/a", "Mesh")
    assert findings(stage)


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path: Path):
    pytest.importorskip("pxr")
    motion = sample()
    for broken in (motion.sliced(0, 0), replace(motion, t_world_root=motion.t_world_root * float("nan"))):
        with pytest.raises(WearcapError):
            wearcap.save(broken, tmp_path / "m.usd")
    with pytest.raises(WearcapError, match="rod"):
        usd_writer()(motion, tmp_path / "m.usdz", blob(Skeleton("rod", ("a",), (-1,), torch.zeros(1, 3))))
    assert list(tmp_path.iterdir()) == []


def test_a_missing_extra_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.delitem(sys.modules, "wearcap.io.formats.usd", raising=False)
    with pytest.raises(WearcapError, match=r'pxr.*pip install "wearcap\[usd\]"'):
        wearcap.save(sample(), tmp_path / "m.usd")
