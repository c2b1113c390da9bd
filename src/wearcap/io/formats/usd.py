"""Motion as Universal Scene Description (.usd, .usda, .usdc, .usdz): UsdSkel's skeleton, animation and skinned body.

In wearcap's axes (z up, metres). Time code 0 is the motion's first frame, a time code is a frame at the motion's nominal rate,
and frames that are not evenly spaced have codes between whole ones. Needs the extra `usd`.
"""

# pyright: reportAttributeAccessIssue=false
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils, Vt
from torch import Tensor

from wearcap.body.model import BodyModel
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.gltf import SkinnedMesh, quats_xyzw, require_drawable
from wearcap.io.formats.motion_npz import STILL_FPS, nominal_fps
from wearcap.recording.motion import HANDS, Motion
from wearcap.scene.objects import Environment

ESTIMATES = {"contact_prob": FOOT_PATCHES, "hand_contact_prob": HANDS, "joint_std": None}
"""Estimates that become arrays `wearcap:NAME` of the figure over time, with `wearcap:NAME:parts` (None: the joints) beside."""
_CODE_NOISE = 1e-5
"""Distance of a time code from a whole number that comes of rounding its time."""
_POINT_M = 0.01
"""Diameter of a cloud's points."""
_SKIN = {"diffuseColor": Gf.Vec3f(0.62, 0.68, 0.76), "roughness": 0.7, "metallic": 0.0}


def write_usd(
    motion: Motion,
    path: str | Path,
    body: BodyModel | None = None,
    environment: Environment | None = None,
    scan: Mesh | None = None,
) -> None:
    """Write a motion and its body; without a body, sticks stand for the bones.

    Objects that move have the meshes of `environment`, or none. `scan` (world axes, m; a cloud has no faces) is written
    beside, as PATH_scan.usdc, and referred to; a .usdz holds it. Raises WearcapError for a motion that is empty, not finite
    or not rising in time, for a body with other joints, and when it cannot be written.
    """
    require_drawable(motion, path)
    path = Path(path)
    # USD replaces what it saves by a file of its own, so that it saves elsewhere, and its bytes are copied.
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder, path.name).with_suffix(".usdc" if path.suffix == ".usdz" else path.suffix)
        scan_file = Path(folder, f"{path.stem}_scan.usdc")
        if scan is not None:
            _write_scan(scan, scan_file)
        _write_stage(motion, layer, body, environment, None if scan is None else scan_file.name)
        if path.suffix == ".usdz":
            package = layer.with_suffix(".usdz")
            if not UsdUtils.CreateNewUsdzPackage(str(layer), str(package)):
                raise WearcapError("cannot be packed", path, "a file that can be written")
            made = [package]
        else:
            made = [layer] if scan is None else [scan_file, layer]
        for file in made:
            with atomic_path(path.with_name(file.name)) as temporary:
                shutil.copyfile(file, temporary)


@contextmanager
def _stage(path: Path, root: str) -> Iterator[tuple[Usd.Stage, Usd.Prim]]:
    """A new stage in wearcap's axes and its default prim; saved at the end."""
    try:
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        top = UsdGeom.Xform.Define(stage, f"/{root}").GetPrim()
        stage.SetDefaultPrim(top)
        Usd.ModelAPI(top).SetKind(Kind.Tokens.component)
        yield stage, top
        stage.Save()
    except Tf.ErrorException as error:
        raise WearcapError(f"cannot be written ({error})", path.parent, "a folder with space") from error


def _write_scan(scan: Mesh, path: Path) -> None:
    with _stage(path, "scan") as (stage, top):
        _define_mesh(stage, top.GetPath().AppendChild("surface"), scan)


def _write_stage(
    motion: Motion, path: Path, body: BodyModel | None, environment: Environment | None, scan_name: str | None
) -> None:
    rate = nominal_fps(motion.fps) if len(motion) > 1 else STILL_FPS
    start_s = motion.timestamps[0].item()
    codes = _codes(motion.timestamps, start_s, rate)
    with _stage(path, "motion") as (stage, top):
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetStartTimeCode(codes[0])
        stage.SetEndTimeCode(codes[-1])
        about = {"start_s": start_s} | {f"provenance_{key}": value for key, value in motion.provenance.items()}
        stage.GetRootLayer().customLayerData = {"wearcap": about}
        shown = SkinnedMesh.sticks(motion.skeleton) if body is None else SkinnedMesh.of_body(body, motion.skeleton)
        _add_figure(stage, motion, shown, codes)
        for name, (identifier, track) in _identified(motion.object_motion or {}).items():
            if len(track):
                mesh = None if environment is None else environment.by_name(name).mesh
                place = top.GetPath().AppendPath(f"objects/{identifier}")
                _add_object(stage, place, track, _codes(track.timestamps, start_s, rate), mesh)
        if scan_name is not None:
            stage.DefinePrim(top.GetPath().AppendChild("scan")).GetReferences().AddReference(f"./{scan_name}")


def _codes(timestamps: Float64[Tensor, "time"], start_s: float, rate: float) -> list[float]:
    """Time codes; a whole number where only its rounding is in the way."""
    codes = (timestamps - start_s).double().numpy() * rate
    whole = np.rint(codes)
    return np.where(np.abs(codes - whole) < _CODE_NOISE, whole, codes).tolist()


def _add_figure(stage: Usd.Stage, motion: Motion, shown: SkinnedMesh, codes: list[float]) -> None:
    """SkelRoot with skeleton, animation, body and estimates."""
    skeleton = motion.skeleton
    root = UsdSkel.Root.Define(stage, "/motion/figure")
    skel = UsdSkel.Skeleton.Define(stage, "/motion/figure/skeleton")
    animation = UsdSkel.Animation.Define(stage, "/motion/figure/skeleton/animation")
    joints = _joint_paths(skeleton)
    rest = skeleton.rest_joints.double().numpy()
    local = skeleton.t_parent_joint.double().numpy()
    local[0] = 0  # the rest pose has its root at the origin
    skel.CreateJointsAttr(joints)
    skel.CreateJointNamesAttr(list(skeleton.joint_names))
    skel.CreateBindTransformsAttr(_translations(rest))
    skel.CreateRestTransformsAttr(_translations(local))
    UsdSkel.BindingAPI.Apply(skel.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr(Vt.Vec3hArray(len(joints), Gf.Vec3h(1, 1, 1)))
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    quats = np.stack([quats_xyzw(R) for R in motion.R_parent_joint.unbind(1)], 1)
    places = np.tile(local.astype(np.float32), (len(motion), 1, 1))
    places[:, 0] = motion.t_world_root.float().numpy()
    for code, quat, place in zip(codes, quats, places):
        rotations.Set(Vt.QuatfArray.FromNumpy(quat), code)
        translations.Set(Vt.Vec3fArray.FromNumpy(place), code)
    mesh = _define_mesh(stage, root.GetPath().AppendChild("body"), shown.mesh)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(shown.normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skel.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 4).Set(Vt.IntArray.FromNumpy(shown.joints.astype(np.int32).ravel()))
    binding.CreateJointWeightsPrimvar(False, 4).Set(Vt.FloatArray.FromNumpy(shown.weights.ravel()))
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    _give_skin(stage, mesh)
    # Around the joints by the distance at which the body's vertices lie from theirs.
    reach = np.linalg.norm(shown.mesh.vertices[:, None] - rest[shown.joints], axis=-1)[shown.weights > 0].max()
    all_joints = motion.T_world_joint.t.flatten(0, 1).numpy()
    root.CreateExtentAttr(
        [Gf.Vec3f(*(all_joints.min(0) - reach).tolist()), Gf.Vec3f(*(all_joints.max(0) + reach).tolist())]
    )
    _add_estimates(root.GetPrim(), motion, codes)


def _add_estimates(prim: Usd.Prim, motion: Motion, codes: list[float]) -> None:
    for name, parts in ESTIMATES.items():
        values = getattr(motion, name)
        if values is None:
            continue
        names = motion.skeleton.joint_names if parts is None else parts
        prim.CreateAttribute(f"wearcap:{name}:parts", Sdf.ValueTypeNames.StringArray).Set(list(names))
        attribute = prim.CreateAttribute(f"wearcap:{name}", Sdf.ValueTypeNames.FloatArray)
        for code, row in zip(codes, values.float().numpy()):
            attribute.Set(Vt.FloatArray.FromNumpy(row), code)


def _add_object(stage: Usd.Stage, place: Sdf.Path, track: Trajectory, codes: list[float], mesh: Mesh | None) -> None:
    """An object's pose over time, and its mesh."""
    xform = UsdGeom.Xform.Define(stage, place)
    translate, orient = xform.AddTranslateOp(), xform.AddOrientOp()
    for code, t, (x, y, z, w) in zip(codes, track.t_world_body.tolist(), quats_xyzw(track.R_world_body).tolist()):
        translate.Set(Gf.Vec3d(*t), code)
        orient.Set(Gf.Quatf(w, x, y, z), code)
    if mesh is not None:
        _define_mesh(stage, place.AppendChild("surface"), mesh)


def _define_mesh(stage: Usd.Stage, place: Sdf.Path, mesh: Mesh) -> Any:
    """A mesh, or the points of one without faces, with its colours."""
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices, np.float32))
    if len(mesh.faces):
        prim = UsdGeom.Mesh.Define(stage, place)
        prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(mesh.faces), 3))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
    else:
        prim = UsdGeom.Points.Define(stage, place)
        prim.CreateWidthsAttr([_POINT_M])
        prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    prim.CreatePointsAttr(points)
    prim.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(prim, Usd.TimeCode.Default()))
    rows = {1: UsdGeom.Tokens.constant, len(mesh.vertices): UsdGeom.Tokens.vertex}
    color = np.atleast_2d(mesh.color).astype(np.float32)
    shades = prim.CreateDisplayColorPrimvar(rows.get(len(color), UsdGeom.Tokens.uniform))
    shades.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(color)))
    return prim


def _give_skin(stage: Usd.Stage, mesh: UsdGeom.Mesh) -> None:
    """The skin's material, as the .glb has it."""
    material = UsdShade.Material.Define(stage, "/motion/figure/skin")
    shader = UsdShade.Shader.Define(stage, "/motion/figure/skin/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, value in _SKIN.items():
        kind = Sdf.ValueTypeNames.Float if isinstance(value, float) else Sdf.ValueTypeNames.Color3f
        shader.CreateInput(name, kind).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _translations(t: Float64[np.ndarray, "joint 3"]) -> Vt.Matrix4dArray:
    """USD's matrices multiply rows: translations stand in the last one."""
    matrices = np.tile(np.eye(4), (len(t), 1, 1))
    matrices[:, 3, :3] = t
    return Vt.Matrix4dArray.FromNumpy(matrices)


def _joint_paths(skeleton: Skeleton) -> list[str]:
    """The joints' names as USD has them: paths of identifiers, the root's first."""
    paths: list[str] = []
    for (identifier, _), parent in zip(_identified(dict.fromkeys(skeleton.joint_names)).values(), skeleton.parents):
        paths.append(identifier if parent < 0 else f"{paths[parent]}/{identifier}")
    return paths


def _identified(named: dict[str, Any]) -> dict[str, tuple[str, Any]]:
    """Each name's identifier of USD (letters, digits, underscores; unique) and value."""
    taken: Counter[str] = Counter()
    found = {}
    for name, value in named.items():
        identifier = Tf.MakeValidIdentifier(name)
        taken[identifier] += 1
        found[name] = (identifier if taken[identifier] == 1 else f"{identifier}_{taken[identifier]}", value)
    return found
