"""SMPL, SMPL+H and SMPL-X surfaces from the arrays of the user's own model files (see `io/formats/smpl.py`)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from wearcap.body.model import BodyModel, contact_regions, four_weights
from wearcap.body.retarget import fit_offsets
from wearcap.body.skeleton import SIDES, Site, Skeleton
from wearcap.body.skeletons import skeleton_by_name
from wearcap.errors import WearcapError

_WORLD_MODEL = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation that maps the files' axes (x left, y up, z forward) to ours."""
_SKELETON_OF = {24: "smpl24", 52: "smplh52", 55: "smplx22"}


@dataclass(frozen=True, eq=False)
class SmplArrays:
    """A model file's arrays, in the file's axes (m)."""

    template: Float[Tensor, "vertex 3"]
    shape_directions: Float[Tensor, "vertex 3 beta"]
    pose_directions: Float[Tensor, "vertex 3 feature"] | None
    """Pose blend shapes: offsets per entry of (R_parent_joint - I) of all joints but the root."""
    joint_regressor: Float[Tensor, "joint vertex"]
    weights: Float[Tensor, "vertex joint"]
    parents: tuple[int, ...]
    faces: Int64[Tensor, "face 3"]


def smpl_body(arrays: SmplArrays, betas: Float[Tensor, "beta"] | None = None) -> BodyModel:
    """The body of one shape, its root at the origin; fewer betas than the file has are filled with zeros.

    The skeleton is smpl24, smplh52 or, for SMPL-X, smplx22 (hands move with the wrists, jaw and eyes with the
    head), with the model's own joints. Raises WearcapError for another number of joints or too many betas.
    """
    count = len(arrays.parents)
    if count not in _SKELETON_OF:
        raise WearcapError(f"a body model of {count} joints", expected="24 (SMPL), 52 (SMPL+H) or 55 (SMPL-X)")
    available = arrays.shape_directions.shape[-1]
    if betas is not None and len(betas) > available:
        raise WearcapError(f"{len(betas)} shape coefficients", expected=f"at most this file's {available}")
    vertices = arrays.template
    if betas is not None:
        vertices = vertices + arrays.shape_directions[..., : len(betas)] @ betas.to(vertices)
    joints = arrays.joint_regressor @ vertices
    vertices, joints = ((points - joints[0]) @ _WORLD_MODEL.to(points).T for points in (vertices, joints))
    named = skeleton_by_name(_SKELETON_OF[count])
    carrier = list(range(count))  # the nearest ancestor that the skeleton keeps, for each joint of the file
    for joint in range(len(named), count):
        carrier[joint] = carrier[arrays.parents[joint]]
    weights = arrays.weights.new_zeros(len(vertices), len(named)).index_add_(1, torch.tensor(carrier), arrays.weights)
    if arrays.parents[: len(named)] != named.parents:
        raise WearcapError(f"a joint tree other than {named.name}'s", expected="an SMPL family file")
    offsets = joints[: len(named)] - joints[[max(parent, 0) for parent in named.parents]]
    skeleton = named.with_offsets(offsets.float())
    skin_joints, skin_weights = four_weights(weights)
    regions = contact_regions(skeleton, skeleton.rest_joints, vertices.float(), arrays.faces, weights.float())
    # Heels, toe tips and crown are found on the surface.
    at = {"crown": ("head", vertices[vertices[:, 2].argmax()])}
    for side in SIDES:
        heel, toes = (vertices[regions[f"{side}_{part}"]] for part in ("heel", "toes"))
        sole = torch.minimum(heel[:, 2].min(), toes[:, 2].min())
        at[f"{side}_heel"] = (f"{side}_ankle", torch.stack([heel[:, 0].min(), heel[:, 1].mean(), sole]))
        at[f"{side}_toe_tip"] = (f"{side}_foot", torch.stack([toes[:, 0].max(), toes[:, 1].mean(), sole]))
    sites = {}
    for name, (joint, place) in at.items():
        x, y, z = (place - skeleton.rest_joints[skeleton.index(joint)]).tolist()
        sites[name] = Site(joint, (x, y, z))
    skeleton = replace(skeleton, sites=skeleton.sites | sites)
    blend = None
    if arrays.pose_directions is not None:
        # In our axes, per entry of our (R_parent_joint - I), of the joints that the skeleton keeps.
        P = _WORLD_MODEL.to(arrays.pose_directions)
        entries = arrays.pose_directions.unflatten(-1, (-1, 3, 3))[..., : len(named) - 1, :, :]
        blend = torch.einsum("dc,vcjab,ka,lb->jklvd", P, entries, P, P).flatten(0, 2).float()
    return BodyModel(skeleton, vertices.float(), arrays.faces, skin_joints, skin_weights.float(), regions, blend)


def template_pelvis(arrays: SmplArrays, betas: Float[Tensor, "beta"]) -> Float[Tensor, "3"]:
    """The pelvis (m) of a shape in the file's axes, which SMPL's translation leaves out."""
    vertices = arrays.template + arrays.shape_directions[..., : len(betas)] @ betas.to(arrays.template)
    return arrays.joint_regressor[0] @ vertices


FITTED_BETAS = 10
"""Most shape coefficients that `betas_of` fits; later ones change details, not bones."""
BONE_M, FIT_STEPS = 0.005, 10
"""Deviation (m) of a bone's length beside a coefficient's deviation of 1, and Gauss-Newton steps."""


def betas_of(arrays: SmplArrays, skeleton: Skeleton) -> Float[Tensor, "beta"]:
    """Shape coefficients of the body whose bones are as long as a wearer's: least squares over all bones' lengths, with
    the model's own distribution of shapes (deviation 1 each) as prior."""
    body = smpl_body(arrays)
    wanted = fit_offsets(skeleton, body.skeleton).t_parent_joint[1:].double().norm(dim=-1)
    count = min(FITTED_BETAS, arrays.shape_directions.shape[-1])
    parents = torch.tensor(body.skeleton.parents[1:])
    regressor = arrays.joint_regressor.double()
    template = regressor @ arrays.template.double()
    directions = torch.einsum("jv,vab->jab", regressor, arrays.shape_directions[..., :count].double())
    bones, per_beta = (x[1 : len(parents) + 1] - x[parents] for x in (template, directions))
    betas = bones.new_zeros(count)
    for _ in range(FIT_STEPS):
        vectors = bones + per_beta @ betas
        lengths = vectors.norm(dim=-1)
        jacobian = (vectors / lengths.clamp_min(1e-9)[:, None])[:, None] @ per_beta
        A = jacobian[:, 0] / BONE_M
        betas = betas + torch.linalg.solve(A.T @ A + torch.eye(count).to(A), A.T @ (wanted - lengths) / BONE_M - betas)
    return betas.float()
