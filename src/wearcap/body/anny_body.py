"""The default human body: Anny, with its proportions fitted to a skeleton's bones.

The person stands in Anny's own A-pose while being fitted; the surface is then taken back to the skeleton's rest
pose through the inverse of the skinning, so that lowered arms look as the artists made them.
"""

from collections import OrderedDict

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor

from wearcap.body.anny_assets import AnnyAssets, load_assets
from wearcap.body.anny_warp import Fit, fit_to
from wearcap.body.landmarks import TPose, t_pose
from wearcap.body.model import BodyModel, contact_regions, four_weights
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError

_CACHE: OrderedDict[tuple, BodyModel] = OrderedDict()
_CACHE_SIZE = 32
DENSITY = 1000.0
"""Density of a human body with half-full lungs (kg/m³)."""
SURFACE_VERTICES = 4000
_BUILDS = (
    {"muscle": 0.0, "weight": 0.0},
    {"muscle": 0.5, "weight": 0.0},
    {"muscle": 0.5, "weight": 0.5},
    {"muscle": 0.5, "weight": 1.0},
    {"muscle": 0.0, "weight": 1.0},
)
"""Phenotypes from lightest to heaviest (about 44 to 112 kg at 1.72 m): Anny's weight alone spans 58 to 72 kg."""
_SPINE = ("spine05", "spine04", "spine03", "spine02", "spine01")
_SPINE_KNOTS = ("pelvis", "spine-4", "spine-3", "spine-2", "spine-1", "neck")
_NECK = ("neck01", "neck02", "neck03")
_FINGERS = {"finger1": "thumb", "finger2": "index", "finger3": "middle", "finger4": "ring", "finger5": "pinky"}
_LIMBS = {
    "upperleg": ("leg", 0),
    "lowerleg": ("leg", 1),
    "foot": ("leg", 2),
    "upperarm": ("arm", 0),
    "lowerarm": ("arm", 1),
    "wrist": ("arm", 2),
    "metacarpal": ("arm", 2),
    "finger": ("arm", 2),
}


def anny_body(
    skeleton: Skeleton, shape: dict[str, float] | None = None, vertices: int | None = SURFACE_VERTICES
) -> BodyModel:
    """A human body surface on the skeleton's joints; cached in memory per skeleton and shape.

    `shape` may state "weight" (kg), "gender" (0 male … 1 female), "muscle" and "proportions" (0…1); height comes
    from the bones. `vertices` is the surface's size, None for all 13,500. Raises WearcapError where the
    skeleton's limbs are not recognised or the package anny is missing.
    """
    shape = shape or {}
    sites = tuple(sorted((name, site.joint, site.t_joint_site) for name, site in skeleton.sites.items()))
    offsets = skeleton.t_parent_joint.numpy().tobytes()
    key = (skeleton.joint_names, offsets, sites, tuple(sorted(shape.items())), vertices)
    if key not in _CACHE:
        _CACHE[key] = _build(skeleton, shape, load_assets(vertices))
        if len(_CACHE) > _CACHE_SIZE:
            _CACHE.popitem(last=False)
    _CACHE.move_to_end(key)
    return _CACHE[key]


def _build(skeleton: Skeleton, shape: dict[str, float], assets: AnnyAssets) -> BodyModel:
    """Fit height and proportions, where not stated, to the skeleton's bones, and the build to the stated weight."""
    wanted = shape.get("weight")
    if wanted is not None and not 10 <= wanted <= 400:
        raise WearcapError(f"a weight of {wanted}", expected="kilograms, 10 to 400")
    stated = {name: float(shape[name]) for name in ("gender", "muscle", "proportions") if name in shape}
    small = assets.restricted(np.unique(np.concatenate(list(assets.joints.values()))))
    free = [name for name in ("height", "proportions") if name not in stated]

    def misfit(values: np.ndarray) -> np.ndarray:
        person = small.joint_positions(small.shaped(stated | dict(zip(free, values))))
        return Fit(skeleton, person).log_ratios

    values = least_squares(misfit, np.full(len(free), 0.5), bounds=(0.0, 1.0), diff_step=0.05, max_nfev=12).x
    phenotype = stated | dict(zip(free, values.tolist()))
    weights = _skin_weights(assets, skeleton)
    if wanted is not None:
        builds = [phenotype | build | stated for build in _BUILDS]
        kilograms = [_body(assets, skeleton, build, weights).volume * DENSITY for build in builds]
        for name in ("muscle", "weight"):
            phenotype[name] = float(np.interp(wanted, kilograms, [build.get(name, 0.5) for build in builds]))
    return _body(assets, skeleton, phenotype, weights)


def _skin_weights(assets: AnnyAssets, skeleton: Skeleton) -> Float[Tensor, "vertex joint"]:
    """Weights of the surface's vertices on the skeleton's joints, merged from Anny's bones; rows sum to 1."""
    pose = t_pose(skeleton)
    # The trunk joints' shares of Anny's five spine bones, by height above the hips.
    person = assets.joint_positions(assets.shaped({}))
    floor = (person["l-upper-leg"][2] + person["r-upper-leg"][2]) / 2
    source = np.array([person[name][2] - floor for name in _SPINE_KNOTS])
    source = source / source[-1]
    trunk = [pose.marks.root, *pose.marks.spine]
    end = pose.marks.neck[0] if pose.marks.neck else pose.marks.head
    centre = pose.hip_centre[2].item()
    target = np.array([0.0, *((pose.t[[*pose.marks.spine, end], 2] - centre).tolist())])
    target = target / target[-1]
    low = np.maximum(source[:-1, None], target[None, :-1])
    high = np.minimum(source[1:, None], target[None, 1:])
    spine = np.maximum(high - low, 0) + 1e-9
    spine /= spine.sum(1, keepdims=True)
    neck = pose.marks.neck or (pose.marks.spine[-1],)
    share = np.zeros((len(assets.bones), len(skeleton)), dtype=np.float32)
    for row, bone in enumerate(assets.bones):
        if bone in _SPINE:
            share[row, trunk] = spine[_SPINE.index(bone)].astype(np.float32)
        elif bone in _NECK:
            share[row, neck[min(len(neck) - 1, _NECK.index(bone) * len(neck) // len(_NECK))]] = 1
        else:
            share[row, _joint_of(bone, skeleton, pose)] = 1
    return torch.from_numpy(assets.weights @ share)


def _joint_of(bone: str, skeleton: Skeleton, pose: TPose) -> int:
    """The skeleton's joint for a bone of limbs, head or pelvis."""
    marks = pose.marks
    if bone == "root" or bone.startswith("pelvis"):
        return marks.root
    if bone.startswith("breast"):
        return marks.spine[-1]
    side = {"L": "left", "R": "right"}.get(bone[-1], "")
    if bone.startswith(("clavicle", "shoulder")):
        collar = marks.collar[side]
        return marks.spine[-1] if collar is None else collar
    if bone.startswith("toe"):
        toe = marks.toe[side]
        return marks.limb[f"{side}_leg"][2] if toe is None else toe
    named = f"{side}_{_FINGERS.get(bone[:7], '')}{bone[8:9]}"
    if bone.startswith("finger") and named in skeleton:
        return skeleton.index(named)
    if bone == "lowerarm02.L" or bone == "lowerarm02.R":
        return marks.forearm[side]
    for word, (limb, place) in _LIMBS.items():
        if bone.startswith(word):
            return marks.limb[f"{side}_{limb}"][place]
    return marks.head


def _body(
    assets: AnnyAssets, skeleton: Skeleton, phenotype: dict[str, float], weights: Float[Tensor, "vertex joint"]
) -> BodyModel:
    person = assets.shaped(phenotype)
    fit = Fit(skeleton, assets.joint_positions(person))
    standing = torch.from_numpy(fit_to(fit, assets, person))
    skin_joints, skin_weights_4 = four_weights(weights)
    used = torch.zeros_like(weights).scatter_(1, skin_joints, skin_weights_4)
    faces = torch.from_numpy(assets.faces)
    R_pose, t_pose = fit.T_rest_to_standing
    shift = t_pose - (R_pose @ skeleton.rest_joints.double()[..., None])[..., 0]
    affine = (used.double() @ torch.cat([R_pose, shift[..., None]], -1).flatten(-2)).unflatten(-1, (3, 4))
    rest = torch.linalg.solve(affine[..., :3], standing.double() - affine[..., 3])
    T_pose = fit.target_t_pose
    turned = (used.double() @ T_pose.R.flatten(-2)).unflatten(-1, (3, 3))
    shift_t = used.double() @ (T_pose.t - (T_pose.R @ skeleton.rest_joints.double()[..., None])[..., 0])
    in_t_pose = (turned @ rest[..., None])[..., 0] + shift_t
    regions = contact_regions(skeleton, T_pose.t, in_t_pose, faces, used.double())
    return BodyModel(skeleton, rest.float(), faces, skin_joints, skin_weights_4.float(), regions)
