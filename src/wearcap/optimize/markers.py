"""A body fitted to optical markers: bones and places of markers once per person, then the pose of every frame (ours).

All frames are solved at once by Levenberg-Marquardt (Marquardt 1963) with analytic derivatives. A marker's residual is
p − y, p = t_a + R_b o, for a marker that sits at o from joint a in the frame of joint b. Turning a joint j by δ in its own
axes moves it by R_j δ × (p − t_j) if b is j or hangs on it. A person's bones and offsets are shared by all frames, so that
the normal equations have an arrow's form; the poses are eliminated frame by frame (Schur complement).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.landmarks import head_level
from wearcap.body.position_fit import fit_positions
from wearcap.body.skeleton import Skeleton, skeleton_of_height, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.io.formats.trc import Markers
from wearcap.optimize.costs import Loss
from wearcap.recording.motion import Motion

MARKER_M = 0.01
"""Deviation of a marker from the body (standard deviation, m): skin that slides over bone."""
_LOSS = Loss("cauchy", 0.05)
"""Markers farther off than 5 cm (swapped, or on clothes) lose their weight."""
_SIDED = {
    "FHD": ("head", "head", (0.10, 0.070, 0.130), (0.03, 0.01, 0.02)),
    "BHD": ("head", "head", (-0.08, 0.065, 0.120), (0.03, 0.01, 0.02)),
    "SHO": ("left_shoulder", "left_collar", (-0.005, -0.01, 0.055), (0.015, 0.02, 0.015)),
    "UPA": ("left_shoulder", "left_shoulder", (0.0, 0.15, 0.045), (0.05, 0.06, 0.03)),
    "ELB": ("left_elbow", "left_shoulder", (0.0, 0.0, 0.045), (0.01, 0.01, 0.01)),
    "FRM": ("left_elbow", "left_elbow", (0.0, 0.12, 0.03), (0.04, 0.05, 0.03)),
    "WRA": ("left_wrist", "left_elbow", (0.032, 0.0, 0.010), (0.012, 0.01, 0.015)),
    "WRB": ("left_wrist", "left_elbow", (-0.032, 0.0, 0.010), (0.012, 0.01, 0.015)),
    "FIN": ("left_wrist", "left_wrist", (0.01, 0.075, 0.018), (0.015, 0.015, 0.01)),
    "ASI": ("pelvis", "pelvis", (0.061, 0.120, 0.073), (0.02, 0.03, 0.015)),
    "PSI": ("pelvis", "pelvis", (-0.086, 0.048, 0.101), (0.015, 0.02, 0.015)),
    "THI": ("left_hip", "left_hip", (0.01, 0.09, -0.16), (0.05, 0.03, 0.08)),
    "KNE": ("left_knee", "left_hip", (0.0, 0.055, 0.02), (0.005, 0.01, 0.015)),
    "TIB": ("left_knee", "left_knee", (-0.01, 0.06, -0.15), (0.05, 0.03, 0.08)),
    "ANK": ("left_ankle", "left_knee", (0.0, 0.042, 0.0), (0.005, 0.008, 0.008)),
    "HEE": ("left_ankle", "left_ankle", (-0.060, 0.0, -0.030), (0.015, 0.015, 0.008)),
    "TOE": ("left_toe", "left_ankle", (0.0, 0.0, 0.035), (0.02, 0.015, 0.008)),
}
_MIDDLE = {
    "C7": ("neck", "t8", (-0.080, 0.0, 0.015), (0.015, 0.005, 0.02)),
    "CLAV": ("neck", "t8", (0.075, 0.0, -0.025), (0.015, 0.005, 0.02)),
    "T10": ("neck", "t8", (-0.10, 0.0, -0.225), (0.02, 0.005, 0.04)),
    "STRN": ("neck", "t8", (0.15, 0.0, -0.20), (0.03, 0.01, 0.04)),
    "RBAK": ("neck", "t8", (-0.11, -0.09, -0.12), (0.03, 0.04, 0.04)),
    "SACR": ("pelvis", "pelvis", (-0.090, 0.0, 0.101), (0.015, 0.005, 0.015)),
}
"""Plug-in-Gait's markers (left ones; middle ones): joint a, joint b, offset o and its standard deviation (m) at 1.75 m.

After Vicon's placement, knees 9, ankles 7 and elbows 7 cm wide; the hip's joint below and behind the ASIS after
Harrington et al. 2007, the pelvis tilted by 11° as people stand.
"""
_NEEDED = {
    "pelvis": (3, "LASI RASI LPSI RPSI SACR"),
    "trunk": (3, "C7 T10 CLAV STRN RBAK"),
    "head": (3, "LFHD RFHD LBHD RBHD"),
} | {
    f"{side} {limb}": (3, " ".join(side[0].upper() + name for name in names.split()))
    for side in ("left", "right")
    for limb, names in (("leg", "KNE ANK HEE TOE"), ("arm", "SHO ELB WRA WRB"))
}
"""Least number of markers of each part of the body, and their names."""
_BONES = (
    (("l5", "l3", "t12", "t8"), 2, 0.06), (("neck", "head"), 2, 0.06),
    (("left_hip", "right_hip"), 1, 0.06), (("left_knee", "right_knee"), 2, 0.06),
    (("left_ankle", "right_ankle"), 2, 0.06), (("left_toe", "right_toe"), 0, 0.10),
    (("left_collar", "right_collar", "left_shoulder", "right_shoulder"), 1, 0.12), (("left_collar", "right_collar"), 2, 0.15),
    (("left_elbow", "right_elbow"), 1, 0.06), (("left_wrist", "right_wrist"), 1, 0.06),
)  # fmt: skip
"""Bones that share a factor: the joints at their ends, the axis that is scaled, and the factor's standard deviation."""
_FREE = 180.0
_PITCH_DEG = {
    **dict.fromkeys(("l5", "l3", "t12", "t8"), (12, 15, 10)), "neck": (20, 20, 25), "head": (20, 20, 25),
    "left_collar": (12, 3, 12), "left_shoulder": (_FREE, 60, _FREE), "left_elbow": (3, 50, _FREE),
    "left_wrist": (30, 3, 15), "left_hip": (30, _FREE, 25), "left_knee": (2, _FREE, 6), "left_ankle": (12, 30, 8),
    "left_toe": (1, 1, 1),
}  # fmt: skip
"""Standard deviation (degrees) of joints' rotation vectors about x (forward), y (left) and z (up) in the T-pose: knees and
elbows are hinges, of which elbows turn about the forearm, too."""
_SHARED_DEG = {("l5", "l3"): 3.0, ("l3", "t12"): 3.0, ("t12", "t8"): 3.0, ("neck", "head"): 12.0}
"""Standard deviation (degrees) of the difference of neighbours that share a bend."""
_HINGES = (("left_knee", 1, 1.0), ("right_knee", 1, 1.0), ("left_elbow", 2, -1.0), ("right_elbow", 2, 1.0))
"""Joints that bend to one side only: their axis, and the sign of flexion about it."""
_STRETCHED_DEG = (5.0, 3.0)
"""Flexion below which a hinge resists, and the standard deviation below it (degrees)."""
EVIDENCE = 20.0
"""Number of independent frames that a person's frames are worth: errors of skin are the same in many of them."""
_FRAMES, _TAPER = 192, 5


@dataclass(frozen=True)
class MarkerBody:
    """A person's bones, and where the markers sit on them: R_b o from joint a."""

    skeleton: Skeleton
    names: tuple[str, ...]
    a: list[int]
    b: list[int]
    t_b_marker: Float[Tensor, "marker 3"]

    def places(self, R: Tensor, t: Tensor) -> Float[Tensor, "time marker 3"]:
        """Markers (m) of a body with joints at `t` in orientations `R`."""
        return t[:, self.a] + (R[:, self.b] @ self.t_b_marker.to(R)[..., None])[..., 0]


@dataclass(frozen=True)
class _Seen:
    """Markers of a body in the frames of a trial, and their weights, 0 where they were not seen (filled in over time)."""

    y: Float[Tensor, "time marker 3"]
    weight: Float[Tensor, "time marker"]


def plug_in_gait(name: str) -> str:
    """A marker's name without its subject ("Anna:LASI") and in capitals."""
    return name.rpartition(":")[2].strip().upper()


def _row(name: str) -> tuple:
    """The row of the tables for a marker's name, mirrored for a right one."""
    if name in _MIDDLE:
        return _MIDDLE[name]
    a, b, (x, y, z), std = _SIDED[name[1:]]
    if name[0] == "L":
        return a, b, (x, y, z), std
    return a.replace("left", "right"), b.replace("left", "right"), (x, -y, z), std


MARKERS = (*_MIDDLE, *(side + name for name in _SIDED for side in "LR"))
"""Names of all markers that can be used."""


def fit_body(trials: Sequence[Markers], where: object = "markers") -> MarkerBody:
    """Bones and markers' places of a person from several trials, of which `_FRAMES` frames are solved together.

    Raises WearcapError naming the markers of a part of the body of which too few are seen.
    """
    seen = {plug_in_gait(name) for trial in trials for name in trial.names} & set(MARKERS)
    for part, (least, among) in _NEEDED.items():
        if len(seen & set(among.split())) < least:
            lacking = ", ".join(name for name in among.split() if name not in seen)
            raise WearcapError(f"too few markers of the {part}: no {lacking}", str(where), f"{least} of {among}")
    body = _nominal_body(tuple(name for name in MARKERS if name in seen), trials)
    each, parts = -(-_FRAMES // len(trials)), []
    for trial in trials[:: -(-len(trials) // _FRAMES)]:
        whole = _seen(body, trial)
        frames = torch.linspace(0, len(whole.y) - 1, min(each, len(whole.y))).round().long()
        parts.append(_Seen(whole.y[frames], whole.weight[frames]))
    seen_frames = _Seen(torch.cat([part.y for part in parts]), torch.cat([part.weight for part in parts]))
    body = _upright_body(body, seen_frames)
    R, t = (torch.cat(part) for part in zip(*(_start(body, part) for part in parts)))
    R, t = _solve_poses(body, seen_frames, R, t)
    body, R, t = _solve_body(body, seen_frames, R, t)
    return _levelled(body, seen_frames, R, t)


def fit_motion(body: MarkerBody, trial: Markers) -> tuple[Motion, Float[Tensor, "time marker"]]:
    """The motion of a person whose body is known, and the distances (m) of the markers from it, NaN where not seen."""
    seen = _seen(body, trial)
    R, t = _solve_poses(body, seen, *_start(body, seen))
    T = forward_kinematics(body.skeleton, R, t)
    distance = (body.places(T.R, T.t) - seen.y).norm(dim=-1)
    distance[seen.weight == 0] = torch.nan
    return Motion(trial.timestamps, body.skeleton, R.float(), t.float()), distance.float()


def _nominal_body(names: tuple[str, ...], trials: Sequence[Markers]) -> MarkerBody:
    """The tables' body, as tall as the head's markers are over the feet's at their highest."""
    heads, feet = [], []
    for trial in trials:
        z, plain = trial.t_world_marker[..., 2], [plug_in_gait(name) for name in trial.names]
        head, foot = (
            z[:, [plain.index(name) for name in plain if name[1:] in kind]].double()
            for kind in (("FHD", "BHD"), ("HEE", "TOE"))
        )
        heads.append(head.nanmean(1).nan_to_num(-torch.inf))
        feet.append(foot.nan_to_num(torch.inf).amin(1))
    base = xsens23()
    high = torch.cat(heads).quantile(0.9) - torch.cat(feet).quantile(0.1) + 0.045
    nominal = base.height_of("head") + _SIDED["FHD"][2][2]
    skeleton = skeleton_of_height(base.stature * high.item() / nominal)
    rows = [_row(name) for name in names]
    a, b = ([skeleton.index(row[k]) for row in rows] for k in (0, 1))
    offsets = torch.tensor([row[2] for row in rows], dtype=torch.float64) * high.item() / nominal
    return MarkerBody(skeleton, names, a, b, offsets)


def _upright(body: MarkerBody, seen: _Seen) -> Bool[Tensor, "time"]:
    """Frames in which the head is highest: people stand."""
    head = [k for k, name in enumerate(body.names) if name[1:] in ("FHD", "BHD")]
    height = seen.y[:, head, 2].mean(1)
    there = (seen.weight[:, head] > 0).all(1)
    return there & (height > height[there].quantile(0.9) - 0.03) if there.any() else there


def _upright_body(body: MarkerBody, seen: _Seen) -> MarkerBody:
    """The tables' body with its markers turned so that pelvis and trunk are level, on the median, while people stand."""
    upright, offsets = _upright(body, seen), body.t_b_marker.clone()
    for joint in body.skeleton.indices("pelvis", "t8"):
        k = torch.tensor([marker for marker, b in enumerate(body.b) if b == joint])
        frames = upright & (seen.weight[:, k] > 0).all(1)
        if frames.any():
            x = body.t_b_marker[k].expand(int(frames.sum()), -1, -1)
            R, *_ = roma.rigid_points_registration(x, seen.y[frames][:, k])
            offsets[k] = offsets[k] @ rotation.about_axis("y", _pitch(R)).T
    return replace(body, t_b_marker=offsets)


def _levelled(body: MarkerBody, seen: _Seen, R: Tensor, t: Tensor) -> MarkerBody:
    """The body with the frames of head and feet, which carry nothing but markers, turned so that they are level while people stand."""
    skeleton, offsets = body.skeleton, body.t_b_marker.clone()
    T = forward_kinematics(skeleton, R, t)
    upright, face = _upright(body, seen), head_level(skeleton, R.float())
    level = {} if face is None else {skeleton.index("head"): face.double().T}
    if upright.any():
        level |= {
            joint: rotation.about_axis("y", _pitch(T.R[upright, joint]))
            for joint in skeleton.indices("left_ankle", "right_ankle")
        }
    for k, (a, b) in enumerate(zip(body.a, body.b)):
        if b in level:
            origin = skeleton.t_parent_joint[a].double() if a != b else torch.zeros(3, dtype=torch.float64)
            offsets[k] = level[b] @ (origin + offsets[k]) - origin
    return replace(body, t_b_marker=offsets)


def _pitch(R: Float[Tensor, "time 3 3"]) -> Float[Tensor, ""]:
    """Median angle (rad) by which x points down."""
    return -R[:, 2, 0].clamp(-1, 1).asin().median()


def _seen(body: MarkerBody, trial: Markers) -> _Seen:
    """A trial's markers in the order of the body's. Weights fade within ten frames of a gap, so that poses do not jump."""
    plain = [plug_in_gait(name) for name in trial.names]
    y = torch.full((len(trial.timestamps), len(body.names), 3), torch.nan, dtype=torch.float64)
    for k, name in enumerate(body.names):
        if name in plain:
            y[:, k] = trial.t_world_marker[:, plain.index(name)]
    valid = y.isfinite().all(-1)
    y[~valid] = torch.nan
    wide = torch.nn.functional.pad(valid.T.double()[None], (2 * _TAPER, 2 * _TAPER), mode="replicate")
    eroded = -torch.nn.functional.max_pool1d(-wide, 2 * _TAPER + 1, 1)
    weight = torch.nn.functional.avg_pool1d(eroded, 2 * _TAPER + 1, 1)[0].T
    frames = np.arange(len(y))
    for k in (~valid).any(0).nonzero()[:, 0].tolist():
        there = valid[:, k].numpy()
        for axis in range(3):
            filled = np.interp(frames, frames[there], y[there, k, axis].numpy()) if there.any() else 0.0
            y[:, k, axis] = torch.as_tensor(filled)
    return _Seen(y, weight)


def _start(body: MarkerBody, seen: _Seen) -> tuple[Tensor, Tensor]:
    """Rough poses: the pelvis by its markers, other joints aimed at places near the markers beside them."""
    ever = (seen.weight.sum(0) > 0).tolist()
    at = {name: seen.y[:, k] for k, name in enumerate(body.names) if ever[k]}
    pelvis = [k for k, name in enumerate(body.names) if body.b[k] == 0 and ever[k]]
    if len(pelvis) < 3:
        raise WearcapError("fewer than three markers of the pelvis in a trial", expected="LASI RASI LPSI RPSI")
    R_root, t_root = roma.rigid_points_registration(
        body.t_b_marker[pelvis].expand(len(seen.y), -1, -1), seen.y[:, pelvis]
    )
    goals = {
        f"{side}_hip": t_root + R_root @ body.skeleton.t_parent_joint[body.skeleton.index(f"{side}_hip")].double()
        for side in ("left", "right")
    }
    near = {"knee": ("KNE",), "ankle": ("ANK",), "toe": ("TOE",), "shoulder": ("SHO",), "elbow": ("ELB",), "wrist": ("WRA", "WRB")}
    for joint, names in near.items():
        for side in ("left", "right"):
            places = [at[side[0].upper() + name] for name in names if side[0].upper() + name in at]
            if places:
                goals[f"{side}_{joint}"] = torch.stack(places).mean(0)
    for joint, names in (("neck", ("C7", "CLAV")), ("head", ("LFHD", "RFHD", "LBHD", "RBHD"))):
        places = [at[name] for name in names if name in at]
        if len(places) == len(names):
            goals[joint] = torch.stack(places).mean(0)
    R = torch.eye(3, dtype=torch.float64).repeat(len(seen.y), len(body.skeleton), 1, 1)
    R[:, 0] = R_root
    return fit_positions(body.skeleton, R, t_root, goals)


def pose_precision(skeleton: Skeleton) -> Float[Tensor, "component component"]:
    """D of the energy θᵀ D θ of all joints' rotation vectors but the root's: soft limits, and neighbours that bend alike."""
    D = torch.zeros(3 * (len(skeleton) - 1), 3 * (len(skeleton) - 1), dtype=torch.float64)
    for name, std in _PITCH_DEG.items():
        for side in {name, name.replace("left", "right")}:
            k = 3 * (skeleton.index(side) - 1)
            D[range(k, k + 3), range(k, k + 3)] += torch.tensor(std).double().deg2rad() ** -2
    eye = torch.eye(3, dtype=torch.float64)
    for (one, other), std in _SHARED_DEG.items():
        i, j = (slice(3 * (k - 1), 3 * k) for k in skeleton.indices(one, other))
        weight = eye / torch.tensor(std).double().deg2rad() ** 2
        D[i, i] += weight
        D[j, j] += weight
        D[i, j] -= weight
        D[j, i] -= weight
    return D


def marker_residual(
    places: Float[Tensor, "time marker 3"], seen: Float[Tensor, "time marker 3"]
) -> Float[Tensor, "time marker 3"]:
    """Offset of the body's markers from the seen ones, in standard deviations."""
    return (places - seen) / MARKER_M


class _Frames:
    """The energy of poses in all frames, and its quadratic model in (t_root, turns of all joints in their own axes)."""

    def __init__(self, body: MarkerBody, seen: _Seen):
        self.body, self.seen = body, seen
        skeleton, dtype = body.skeleton, seen.y.dtype
        self.precision = pose_precision(skeleton).to(dtype)
        above = torch.zeros(len(body.b), len(skeleton), dtype=torch.bool)
        for marker, joint in enumerate(body.b):
            above[marker, skeleton.ancestors(joint)] = True
        self.above = above
        self.hinges = [3 * (skeleton.index(name) - 1) + axis for name, axis, _ in _HINGES]

    def subset(self, frames: Tensor) -> "_Frames":
        return _Frames(self.body, _Seen(self.seen.y[frames], self.seen.weight[frames]))

    def energy(self, R: Tensor, t: Tensor) -> Float[Tensor, "time"]:
        """E = Σ weight · ρ(marker's residual) + θᵀ D θ of each frame."""
        T = forward_kinematics(self.body.skeleton, R, t)
        residual = marker_residual(self.body.places(T.R, T.t), self.seen.y)
        theta = rotation.log(R[:, 1:]).flatten(1)
        limits = self._overstretch(theta).square().sum(-1)
        return self._robust(residual) + ((theta @ self.precision) * theta).sum(-1) + limits

    def _overstretch(self, theta: Float[Tensor, "time component"]) -> Float[Tensor, "time hinge"]:
        """How far knees and elbows are bent the wrong way, in standard deviations; 0 where they are not."""
        sign = torch.tensor([row[2] for row in _HINGES]).to(theta)
        least, std = torch.tensor(_STRETCHED_DEG).deg2rad().to(theta)
        return sign * (sign * theta[:, self.hinges] - least).clamp_max(0.0) / std

    def _robust(self, residual: Tensor) -> Tensor:
        loss = 2 * _LOSS.delta / MARKER_M**2 * _LOSS(residual * MARKER_M)
        return (self.seen.weight * loss).sum(-1)

    def model(self, R: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        """Of the pose: gradient g and matrix H; of the markers: weighted residuals, their derivatives; the joints' orientations;
        the roots of the weights."""
        T = forward_kinematics(self.body.skeleton, R, t)
        places = self.body.places(T.R, T.t)
        residual = marker_residual(places, self.seen.y)
        root = (self.seen.weight / (1 + (residual * MARKER_M / _LOSS.delta).square().sum(-1))).sqrt()[..., None]
        arm = (places[:, :, None] - T.t[:, None]) * self.above[..., None]
        turned = torch.linalg.cross(T.R.mT[:, None], arm[..., None, :])  # time marker joint axis 3
        J = torch.cat([torch.eye(3).to(t).expand(*places.shape[:2], 3, 3), turned.flatten(2, 3)], 2)
        J = (J * (root / MARKER_M)[..., None]).mT.flatten(1, 2)
        r = (residual * root).flatten(1)
        H, g = J.mT @ J, (J.mT @ r[..., None])[..., 0]
        inverse, theta = _inverse_right_jacobian(R[:, 1:])
        count, free = len(R), R.shape[1] - 1
        D = self.precision.unflatten(1, (free, 3))
        pulled = torch.einsum("iac,tacd->tiad", D, inverse).flatten(2)  # D blockdiag(J⁻¹)
        both = inverse.mT @ pulled.unflatten(1, (free, 3))
        H[:, 6:, 6:] += both.reshape(count, 3 * free, 3 * free)
        pull = theta.flatten(1) @ self.precision
        over, std = self._overstretch(theta.flatten(1)), math.radians(_STRETCHED_DEG[1])
        pull[:, self.hinges] += over / std
        g[:, 6:] += (inverse.mT @ pull.unflatten(1, (free, 3))[..., None]).flatten(1)
        for k, component in enumerate(self.hinges):
            joint, axis = divmod(component, 3)
            row = inverse[:, joint, axis] * (over[:, k, None] != 0) / std
            at = slice(6 + 3 * joint, 9 + 3 * joint)
            H[:, at, at] += row[:, :, None] * row[:, None]
        return g, H, r, J, T.R, (root / MARKER_M)[..., 0]


def _inverse_right_jacobian(R: Float[Tensor, "*batch 3 3"]) -> tuple[Tensor, Tensor]:
    """J⁻¹ of log(R exp(δ)) ≈ θ + J⁻¹ δ, and θ."""
    theta = rotation.log(R)
    square = (theta**2).sum(-1)
    half = (square.clamp_min(1e-8).sqrt() / 2).clamp_max(3.1 / 2)
    share = torch.where(square < 1e-4, 1 / 12, (1 - half / half.tan()) / square.clamp_min(1e-8))[..., None, None]
    K = _cross(theta)
    return torch.eye(3).to(R) + K / 2 + share * K @ K, theta


def _cross(v: Tensor) -> Tensor:
    zero = torch.zeros_like(v[..., 0])
    rows = [zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _moved(R: Tensor, t: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    turns = step[:, 3:].unflatten(1, (-1, 3))
    size = turns.norm(dim=-1, keepdim=True)
    return R @ rotation.exp(turns * (0.6 / size.clamp_min(0.6))), t + step[:, :3]


def _solve_poses(body: MarkerBody, seen: _Seen, R: Tensor, t: Tensor, iterations: int = 25) -> tuple[Tensor, Tensor]:
    """Poses of all frames from rough ones, each frame with a damping of its own, until its energy falls by less than 0.1 %."""
    R, t, problem = R.clone(), t.clone(), _Frames(body, seen)
    energy, damping = problem.energy(R, t), torch.full_like(t[:, 0], 1e-3)
    active = torch.arange(len(t))
    for _ in range(iterations):
        part = problem.subset(active)
        g, H, *_ = part.model(R[active], t[active])
        diagonal = H.diagonal(dim1=1, dim2=2)
        diagonal += damping[active, None] * diagonal + 1e-6
        step = torch.cholesky_solve(-g[..., None], torch.linalg.cholesky(H))[..., 0]
        R_new, t_new = _moved(R[active], t[active], step)
        fallen = energy[active] - part.energy(R_new, t_new)
        better = fallen > 0
        chosen = active[better]
        R[chosen], t[chosen] = R_new[better], t_new[better]
        energy[chosen] -= fallen[better]
        damping[active] *= torch.where(better, 0.2, 8.0).to(damping)
        done = better & (fallen < 1e-3 * energy[active]) | (damping[active] > 1e4)
        active = active[~done]
        if not len(active):
            break
    return R, t


def _solve_body(body: MarkerBody, seen: _Seen, R: Tensor, t: Tensor, iterations: int = 30) -> tuple[MarkerBody, Tensor, Tensor]:
    """Bones and offsets, with the poses of the frames: the shared unknowns' normal equations, poses eliminated."""
    base, nominal = body.skeleton, body.t_b_marker
    bones = torch.zeros(len(_BONES), len(base), 3, dtype=torch.float64)
    for k, (joints, axis, _) in enumerate(_BONES):
        bones[k, base.indices(*joints), axis] = base.t_parent_joint[base.indices(*joints), axis].double()
    std = torch.cat([torch.tensor([row[2] for row in _BONES]), torch.tensor([_row(n)[3] for n in body.names]).flatten()])
    prior = std.double() ** -2
    x = torch.zeros(len(prior), dtype=torch.float64)
    share, damping = EVIDENCE / len(seen.y), 1e-3

    def at(x: Tensor) -> MarkerBody:
        offsets = base.t_parent_joint.double() + torch.einsum("k,kjc->jc", x[: len(_BONES)], bones)
        return replace(body, skeleton=base.with_offsets(offsets.float()), t_b_marker=nominal + x[len(_BONES) :].view(-1, 3))

    def total(x: Tensor, R: Tensor, t: Tensor) -> Tensor:
        return share * _Frames(at(x), seen).energy(R, t).sum() + (prior * x * x).sum()

    energy = total(x, R, t)
    for _ in range(iterations):
        problem = _Frames(at(x), seen)
        g, H, r, J, R_world, root = problem.model(R, t)
        J_shared = _shared_derivative(body, bones, R_world, root)
        H_ps = J.mT @ J_shared
        H_ss = share * torch.einsum("tra,trb->ab", J_shared, J_shared) + prior.diag()
        g_s = share * torch.einsum("tra,tr->a", J_shared, r) + prior * x
        while damping < 1e6:
            factor = torch.linalg.cholesky(H + torch.diag_embed(damping * H.diagonal(dim1=1, dim2=2) + 1e-6))
            solved = torch.cholesky_solve(torch.cat([H_ps, g[..., None]], -1), factor)
            S = H_ss + damping * H_ss.diagonal().diag() - share * (H_ps.mT @ solved[..., :-1]).sum(0)
            s = g_s - share * (H_ps.mT @ solved[..., -1:]).sum(0)[:, 0]
            dx = -torch.linalg.solve(S, s)
            step = -solved[..., -1] - solved[..., :-1] @ dx
            R_new, t_new = _moved(R, t, step)
            new = total(x + dx, R_new, t_new)
            if new < energy:
                break
            damping *= 8
        else:
            break
        fallen, x, R, t, energy, damping = (energy - new) / energy, x + dx, R_new, t_new, new, 0.2 * damping
        if fallen < 1e-4:
            break
    return at(x), R, t


def _shared_derivative(
    body: MarkerBody,
    bones: Float[Tensor, "bone joint 3"],
    R_world: Float[Tensor, "time joint 3 3"],
    root: Float[Tensor, "time marker"],
) -> Float[Tensor, "time row unknown"]:
    """Derivatives of the weighted residuals in the bones' factors (which move all that follows) and the markers' offsets."""
    skeleton, markers = body.skeleton, len(body.names)
    reach = torch.zeros(markers, len(skeleton), dtype=R_world.dtype)
    for marker, joint in enumerate(body.a):
        reach[marker, skeleton.ancestors(joint)[:-1]] = 1
    R_parent = R_world[:, [max(parent, 0) for parent in skeleton.parents]]
    lengthened = torch.einsum("mj,tjcd,kjd->tmck", reach, R_parent, bones.to(R_world))
    offset = torch.zeros(len(root), markers, 3, markers, 3, dtype=R_world.dtype)
    offset[:, range(markers), :, range(markers)] = R_world[:, body.b].transpose(0, 1)
    return (torch.cat([lengthened, offset.flatten(3)], -1) * root[..., None, None]).flatten(1, 2)
