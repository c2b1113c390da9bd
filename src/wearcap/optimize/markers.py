"""A body fitted to optical markers: bones and places of markers once per person, then the pose of every frame (ours).

All frames are solved at once by Levenberg-Marquardt (Marquardt 1963). A marker that sits at o from joint a in the frame of
joint b has the residual p − y, p = t_a + R_b o; turning a joint j by δ in its own axes moves it by R_j δ × (p − t_j) if j is
b or above it. Bones and offsets are shared by a person's frames: the normal equations have an arrow's form, and poses are
eliminated frame by frame (Schur complement).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.body.position_fit import fit_positions
from wearcap.body.skeleton import Skeleton, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.light_roma import roma
from wearcap.io.formats.trc import Markers
from wearcap.optimize.losses import Loss
from wearcap.recording.motion import Motion

MARKER_M = 0.01
"""Standard deviation (m) of a marker from its place on the body: skin slides over bone."""
_LOSS = Loss("cauchy", 0.05)
"""Markers farther off than 5 cm, swapped ones and those on clothes, lose their weight."""
_MM = {
    "C7": ("neck", "t8", (-80, 0, 15), (15, 5, 20)), "CLAV": ("neck", "t8", (75, 0, -25), (15, 5, 20)),
    "T10": ("neck", "t8", (-100, 0, -225), (20, 5, 40)), "STRN": ("neck", "t8", (150, 0, -200), (30, 10, 40)),
    "RBAK": ("neck", "t8", (-110, -90, -120), (30, 40, 40)), "SACR": ("pelvis", "pelvis", (-90, 0, 101), (15, 5, 15)),
}  # fmt: skip
_SIDED_MM = {
    "FHD": ("head", "head", (100, 70, 130), (30, 10, 20)), "BHD": ("head", "head", (-80, 65, 120), (30, 10, 20)),
    "SHO": ("shoulder", "collar", (-5, -10, 55), (15, 20, 15)), "UPA": ("shoulder", "shoulder", (0, 150, 45), (50, 60, 30)),
    "ELB": ("elbow", "shoulder", (0, 0, 45), (10, 10, 10)), "FRM": ("elbow", "elbow", (0, 120, 30), (40, 50, 30)),
    "WRA": ("wrist", "elbow", (32, 0, 10), (12, 10, 15)), "WRB": ("wrist", "elbow", (-32, 0, 10), (12, 10, 15)),
    "FIN": ("wrist", "wrist", (10, 75, 18), (15, 15, 10)), "ASI": ("pelvis", "pelvis", (61, 120, 73), (20, 30, 15)),
    "PSI": ("pelvis", "pelvis", (-86, 48, 101), (15, 20, 15)), "THI": ("hip", "hip", (10, 90, -160), (50, 30, 80)),
    "KNE": ("knee", "hip", (0, 55, 20), (5, 10, 15)), "TIB": ("knee", "knee", (-10, 60, -150), (50, 30, 80)),
    "ANK": ("ankle", "knee", (0, 42, 0), (5, 8, 8)), "HEE": ("ankle", "ankle", (-60, 0, -30), (15, 15, 8)),
    "TOE": ("toe", "ankle", (0, 0, 35), (20, 15, 8)),
}  # fmt: skip
for _side, _sign in (("left", 1), ("right", -1)):
    for _name, (*_joints, (_x, _y, _z), _std) in _SIDED_MM.items():
        _a, _b = (joint if joint in ("head", "pelvis") else f"{_side}_{joint}" for joint in _joints)
        _MM[_side[0].upper() + _name] = _a, _b, (_x, _sign * _y, _z), _std
_ROWS = {name: (a, b, [x / 1000 for x in o], [x / 1000 for x in std]) for name, (a, b, o, std) in _MM.items()}
MARKERS = tuple(_ROWS)
"""Plug-in-Gait's markers. A row: joints a and b, offset o and its standard deviation (mm, `_ROWS`: m) at 1.75 m.

Placed as Vicon's guide says, knees 9.5, ankles 7 and elbows 7.5 cm wide, the hip's joint below and behind the ASIS after
Harrington et al. 2007 for a pelvis that is tilted by 11°.
"""
_NEEDED = {"pelvis": "LASI RASI LPSI RPSI SACR", "trunk": "C7 T10 CLAV STRN RBAK", "head": "LFHD RFHD LBHD RBHD"} | {
    f"{side} {limb}": " ".join(side[0].upper() + name for name in names)
    for side in ("left", "right")
    for limb, names in (("leg", ("KNE", "ANK", "HEE", "TOE")), ("arm", ("SHO", "ELB", "WRA", "WRB")))
}
"""Markers of each part of the body, of which three are needed."""
_BONES = (
    (("l5", "l3", "t12", "t8"), 2, 0.06), (("neck", "head"), 2, 0.06), (("left_hip", "right_hip"), 1, 0.06),
    (("left_knee", "right_knee"), 2, 0.06), (("left_ankle", "right_ankle"), 2, 0.06),
    (("left_toe", "right_toe"), 0, 0.10), (("left_collar", "right_collar", "left_shoulder", "right_shoulder"), 1, 0.12),
    (("left_collar", "right_collar"), 2, 0.15), (("left_elbow", "right_elbow"), 1, 0.06),
    (("left_wrist", "right_wrist"), 1, 0.06),
)  # fmt: skip
"""Bones that share a factor: the joints at their ends, the axis that is scaled, and the factor's standard deviation."""
_LIMITS_DEG = {
    **dict.fromkeys(("l5", "l3", "t12", "t8"), (12, 15, 10)), **dict.fromkeys(("neck", "head"), (20, 20, 25)),
    "collar": (12, 3, 12), "shoulder": (180, 60, 180), "elbow": (3, 50, 180), "wrist": (30, 3, 15),
    "hip": (30, 180, 25), "knee": (2, 180, 6), "ankle": (12, 30, 8), "toe": (1, 1, 1),
}  # fmt: skip
"""Standard deviation (degrees) of joints' rotation vectors about x (forward), y (left) and z (up) in the T-pose: knees and
elbows are hinges, of which elbows turn about the forearm, too."""
_ALIKE_DEG = (("l5", "l3", 3), ("l3", "t12", 3), ("t12", "t8", 3), ("neck", "head", 12))
"""Neighbours that bend alike, and the standard deviation (degrees) of their difference."""
_HINGES = {"left_knee": (1, 1.0), "right_knee": (1, 1.0), "left_elbow": (2, -1.0), "right_elbow": (2, 1.0)}
"""Joints that bend to one side only: the axis, and the sign of flexion about it."""
_STRAIGHT_DEG, _STRAIGHT_STD_DEG = 5.0, 3.0
"""Flexion (degrees) below which a hinge resists, and the standard deviation below it."""
EVIDENCE = 20.0
"""Number of independent frames that a person's frames are worth: skin errs alike in many of them."""
LARGEST_RMS_M = 0.015
"""Root mean square of the markers' distances from the body above which a trial gets a note."""
_FRAMES, _FADE = 192, 5
_SOFT_M, _ANEW_M = 0.04, 0.02
_NOD = math.radians(7.0)
"""Downward pitch of the head of people who stand, as in `body.landmarks`."""


@dataclass(frozen=True)
class MarkerBody:
    """A person's bones, and where the markers sit: `t_b_marker` from joint a, in the axes of joint b."""

    skeleton: Skeleton
    names: tuple[str, ...]
    a: list[int]
    b: list[int]
    t_b_marker: Float[Tensor, "marker 3"]

    def places(self, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Orientations and places (m) of the joints, and the markers' places, of local rotations and the root's place."""
        T = forward_kinematics(self.skeleton, R, t)
        return T.R, T.t, T.t[:, self.a] + (T.R[:, self.b] @ self.t_b_marker[..., None])[..., 0]


@dataclass(frozen=True)
class _Seen:
    """Markers of a body as seen, gaps filled in over time, and their weights, 0 in gaps."""

    y: Float[Tensor, "time marker 3"]
    weight: Float[Tensor, "time marker"]

    def __getitem__(self, frames: Tensor) -> "_Seen":
        return _Seen(self.y[frames], self.weight[frames])


def plug_in_gait(name: str) -> str:
    """A marker's name without its subject ("Anna:LASI"), in capitals."""
    return name.rpartition(":")[2].strip().upper()


def fit_body(trials: Sequence[Markers]) -> MarkerBody:
    """Bones and markers' places of a person from several trials, of which `_FRAMES` frames are solved together.

    Raises WearcapError naming the missing markers of a part of the body of which less than three are seen.
    """
    there = set[str]()
    for trial in trials:
        seen = trial.t_world_marker.isfinite().all(-1).any(0).tolist()
        there |= {plug_in_gait(name) for name, is_seen in zip(trial.names, seen) if is_seen} & set(MARKERS)
    for part, among in _NEEDED.items():
        lacking = [name for name in among.split() if name not in there]
        if len(among.split()) - len(lacking) < 3:
            raise WearcapError(f"too few markers of the {part}: no {', '.join(lacking)}", expected=f"three of {among}")
    trials = trials[:: -(-len(trials) // _FRAMES)]
    body, parts = _nominal_body(tuple(name for name in MARKERS if name in there), trials), []
    for trial in trials:
        whole, count = _seen(body, trial), -(-_FRAMES // len(trials))
        parts.append(whole[torch.linspace(0, len(whole.y) - 1, min(count, len(whole.y))).round().long()])
    seen = _Seen(torch.cat([part.y for part in parts]), torch.cat([part.weight for part in parts]))
    R, t = _solve_poses(body, seen, *(torch.cat(part) for part in zip(*(_start(body, part) for part in parts))))
    body = _levelled(body, R, t, {"pelvis": 0.0, "t8": 0.0})
    body, R, t = _solve_body(body, seen, R, t)
    # Nothing but markers hangs on head and feet: their frames can be turned without another change.
    return _levelled(body, R, t, {"head": _NOD, "left_ankle": 0.0, "right_ankle": 0.0})


def fit_motion(body: MarkerBody, trial: Markers) -> tuple[Motion, Float[Tensor, "time marker"]]:
    """The motion of a person whose body is known, and the markers' distances (m) from it, NaN where not seen.

    Markers of soft parts that sit elsewhere in this trial, by 2 cm on the mean, are taken to have been placed anew. Frames
    that ended in a worse minimum than others start again from the next good one.
    """
    seen = _seen(body, trial)
    R, t = _solve_poses(body, seen, *_start(body, seen))
    R_world, _, places = body.places(R, t)
    off = (R_world[:, body.b].mT @ (seen.y - places)[..., None])[..., 0]
    mean = (off * seen.weight[..., None]).sum(0) / seen.weight.sum(0).clamp_min(1e-9)[:, None]
    anew = torch.tensor([max(_ROWS[name][3]) >= _SOFT_M for name in body.names]) & (mean.norm(dim=-1) > _ANEW_M)
    body = replace(body, t_b_marker=body.t_b_marker + mean * anew[:, None])
    energy = _energy(body, seen, R, t)
    is_good = energy <= 2 * energy.median()
    again, good = (~is_good | anew.any()).nonzero()[:, 0], is_good.nonzero()[:, 0]
    start = good[torch.searchsorted(good, again).clamp_max(len(good) - 1)]
    R[again], t[again] = _solve_poses(body, seen[again], R[start], t[start])
    distance = (body.places(R, t)[2] - seen.y).norm(dim=-1).where(seen.weight > 0, torch.nan)
    return Motion(trial.timestamps, body.skeleton, R.float(), t.float()), distance.float()


def rms_m(distance: Float[Tensor, "time marker"]) -> float:
    """Root mean square (m) of the distances of markers that were seen."""
    return distance.square().nanmean().sqrt().item()


def fit_notes(body: MarkerBody, trial: Markers, distance: Float[Tensor, "time marker"]) -> list[str]:
    """What is to be known of a fitted trial: what the file holds beside known markers, and markers far from the body."""
    unknown = [name for name in trial.names if plug_in_gait(name) not in MARKERS]
    notes = [f"left out: {trial.left_out}"] if trial.left_out else []
    if unknown:
        notes.append(f"markers left out, whose place is not known: {', '.join(unknown[:20])}")
    if (rms := rms_m(distance)) > LARGEST_RMS_M:
        worst = body.names[int(distance.square().nanmean(0).nan_to_num(0.0).argmax())]
        notes.append(f"markers are {100 * rms:.1f} cm (rms) from the body, most of all {worst}")
    return notes


def _nominal_body(names: tuple[str, ...], trials: Sequence[Markers]) -> MarkerBody:
    """The tables' body, as tall as the head's markers are over the feet's at their highest."""
    base, heights = xsens23(), []
    for trial in trials:
        z, plain = trial.t_world_marker[..., 2], [plug_in_gait(name)[1:] for name in trial.names]
        head, foot = (z[:, [name in kind for name in plain]] for kind in (("FHD", "BHD"), ("HEE", "TOE")))
        lowest = torch.nn.functional.pad(foot.nan_to_num(torch.inf), (0, 1), value=torch.inf).amin(1)
        heights.append(head.nanmean(1) - lowest)
    high = torch.cat(heights).nanquantile(0.9).item() + 0.045
    scale = high / (base.height_of("head") + _ROWS["LFHD"][2][2])
    a, b = (base.indices(*(_ROWS[name][k] for name in names)) for k in (0, 1))
    offsets = scale * torch.tensor([_ROWS[name][2] for name in names], dtype=torch.float64)
    return MarkerBody(base.scaled(scale), names, a, b, offsets)


def _levelled(body: MarkerBody, R: Tensor, t: Tensor, pitches: dict[str, float]) -> MarkerBody:
    """The body with joints' frames turned so that they have a pitch (rad, downward) while people stand, the head highest.

    Pelves are tilted, and bands worn, by each person in another way.
    """
    R_world, t_world, _ = body.places(R, t)
    height, offsets = t_world[:, body.skeleton.index("head"), 2], body.t_b_marker.clone()
    upright = height >= height.quantile(0.9) - 0.03
    for name, pitch in pitches.items():
        joint = body.skeleton.index(name)
        turn = -R_world[upright, joint, 2, 0].clamp(-1, 1).asin().median() - pitch
        for k in [k for k, b in enumerate(body.b) if b == joint]:
            origin = body.skeleton.t_parent_joint[body.a[k]].double() * (body.a[k] != joint)
            offsets[k] = rotation.about_axis("y", turn) @ (origin + offsets[k]) - origin
    return replace(body, t_b_marker=offsets)


def _seen(body: MarkerBody, trial: Markers) -> _Seen:
    """A trial's markers in the body's order. Weights fade within ten frames of a gap, so that poses do not jump."""
    y = torch.full((len(trial.timestamps), len(body.names), 3), torch.nan, dtype=torch.float64)
    for name, place in zip(trial.names, trial.t_world_marker.unbind(1)):
        if plug_in_gait(name) in body.names:
            y[:, body.names.index(plug_in_gait(name))] = place
    valid = y.isfinite().all(-1)
    wide = torch.nn.functional.pad(valid.T.double()[None], (2 * _FADE, 2 * _FADE), mode="replicate")
    eroded = -torch.nn.functional.max_pool1d(-wide, 2 * _FADE + 1, 1)
    for k in (~valid).any(0).nonzero()[:, 0].tolist():
        at = valid[:, k].nonzero()[:, 0].numpy()
        for axis in range(3):
            filled = np.interp(np.arange(len(y)), at, y[at, k, axis].numpy()) if len(at) else np.zeros(len(y))
            y[:, k, axis] = torch.from_numpy(filled)
    return _Seen(y, torch.nn.functional.avg_pool1d(eroded, 2 * _FADE + 1, 1)[0].T)


def _start(body: MarkerBody, seen: _Seen) -> tuple[Tensor, Tensor]:
    """Rough poses: the pelvis by its markers, other joints aimed at places near the markers beside them."""
    at = {name: seen.y[:, k] for k, name in enumerate(body.names) if seen.weight[:, k].any()}
    pelvis = [k for k, name in enumerate(body.names) if body.b[k] == 0 and name in at]
    if len(pelvis) < 3:
        raise WearcapError("less than three markers of the pelvis are seen", expected=_NEEDED["pelvis"])
    x = body.t_b_marker[pelvis].expand(len(seen.y), -1, -1)
    R_root, t_root, *_ = roma.rigid_points_registration(x, seen.y[:, pelvis])
    R = torch.eye(3, dtype=torch.float64).repeat(len(seen.y), len(body.skeleton), 1, 1)
    R[:, 0] = torch.as_tensor(R_root)
    beside = {"neck": ("C7", "CLAV"), "head": ("LFHD", "RFHD", "LBHD", "RBHD")}
    rest, goals = forward_kinematics(body.skeleton, R, t_root).t, {}
    for side in ("left", "right"):
        goals[f"{side}_hip"] = rest[:, body.skeleton.index(f"{side}_hip")]
        ends = {"knee": "KNE", "ankle": "ANK", "toe": "TOE", "shoulder": "SHO", "elbow": "ELB", "wrist": "WRA"}
        beside |= {f"{side}_{joint}": (side[0].upper() + name,) for joint, name in ends.items()}
    for joint, names in beside.items():
        if all(name in at for name in names):
            goals[joint] = torch.stack([at[name] for name in names]).mean(0)
    return fit_positions(body.skeleton, R, t_root, goals)


@cache
def _pose_precision() -> tuple[Float[Tensor, "component component"], list[int], Float[Tensor, "hinge"]]:
    """D of the energy θᵀ D θ of the rotation vectors of all joints but the root: soft limits, and neighbours that bend alike.

    Then the components about which hinges bend, and the signs of their flexion.
    """
    skeleton, eye = xsens23(), torch.eye(3, dtype=torch.float64)
    D = torch.zeros(len(skeleton) - 1, 3, len(skeleton) - 1, 3, dtype=torch.float64)
    for joint, name in enumerate(skeleton.joint_names[1:]):
        std = torch.tensor(_LIMITS_DEG[name.rpartition("_")[2]], dtype=torch.float64).deg2rad()
        D[joint, :, joint] = (std**-2).diag()
    for one, other, std in _ALIKE_DEG:
        for i, j in ((one, one), (other, other), (one, other), (other, one)):
            sign = 1 if i == j else -1
            D[skeleton.index(i) - 1, :, skeleton.index(j) - 1] += sign * eye / math.radians(std) ** 2
    hinges = [3 * (skeleton.index(name) - 1) + axis for name, (axis, _) in _HINGES.items()]
    signs = torch.tensor([sign for _, sign in _HINGES.values()], dtype=torch.float64)
    return D.reshape(3 * len(D), -1), hinges, signs


def overstretch(theta: Float[Tensor, "time component"]) -> Float[Tensor, "time hinge"]:
    """How far knees and elbows are straighter than people like them, in standard deviations; 0 where they are bent."""
    _, hinges, signs = _pose_precision()
    least = math.radians(_STRAIGHT_DEG)
    return signs * (signs * theta[:, hinges] - least).clamp_max(0.0) / math.radians(_STRAIGHT_STD_DEG)


def _energy(body: MarkerBody, seen: _Seen, R: Tensor, t: Tensor) -> Float[Tensor, "time"]:
    """E = Σ weight · ρ((p − y) / σ) + θᵀ D θ + |overstretch|² of each frame."""
    theta = rotation.log(R[:, 1:]).flatten(1)
    loss = 2 * _LOSS.delta / MARKER_M**2 * _LOSS(body.places(R, t)[2] - seen.y)
    pose = ((theta @ _pose_precision()[0]) * theta).sum(-1)
    return (seen.weight * loss).sum(-1) + pose + overstretch(theta).square().sum(-1)


def _model(body: MarkerBody, seen: _Seen, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradient g and matrix H of half the energy in (t_root, turns of all joints in their own axes), the markers' weighted
    residuals r with their derivatives J (time row component), and the roots of the weights (1/m)."""
    R_world, t_world, places = body.places(R, t)
    above = torch.zeros(len(body.b), len(body.skeleton), 1, dtype=torch.float64)
    for marker, joint in enumerate(body.b):
        above[marker, body.skeleton.ancestors(joint)] = 1
    offset = places - seen.y
    root = (seen.weight / (1 + (offset / _LOSS.delta).square().sum(-1))).sqrt() / MARKER_M
    arm = ((places[:, :, None] - t_world[:, None]) * above)[..., None, :]
    turned = torch.linalg.cross(R_world.mT[:, None], arm).flatten(2, 3)
    J = torch.cat([torch.eye(3).to(t).expand(*places.shape[:2], 3, 3), turned], 2)
    J, r = (J * root[..., None, None]).mT.flatten(1, 2), (offset * root[..., None]).flatten(1)
    H, g = J.mT @ J, (J.mT @ r[..., None])[..., 0]
    # Of the joints' rotation vectors, log(R exp(δ)) ≈ θ + K δ with the inverse right Jacobian K.
    theta, (D, hinges, _) = rotation.log(R[:, 1:]), _pose_precision()
    square = theta.square().sum(-1)[..., None, None].clamp_min(1e-6)
    half = square.sqrt() / 2
    across = torch.linalg.cross(theta[..., None, :], torch.eye(3).to(theta)[None, None]).mT
    K = torch.eye(3).to(theta) + across / 2 + (1 - half / half.tan()) / square * across @ across
    flat, std = theta.flatten(1), math.radians(_STRAIGHT_STD_DEG)
    over, pull, stiff = overstretch(flat), flat @ D, D.expand(len(R), -1, -1).clone()
    pull[:, hinges] += over / std
    stiff[:, hinges, hinges] += (over != 0) / std**2
    count = theta.shape[1]
    half_way = (stiff.unflatten(2, (count, 3)).transpose(1, 2) @ K).unflatten(2, (count, 3)).transpose(1, 2)
    H[:, 6:, 6:] += (K.mT[:, :, None] @ half_way).permute(0, 1, 3, 2, 4).reshape(len(R), 3 * count, -1)
    g[:, 6:] += (K.mT @ pull.unflatten(1, (count, 3))[..., None]).flatten(1)
    return g, H, r, J, root


def _moved(R: Tensor, t: Tensor, step: Float[Tensor, "time component"]) -> tuple[Tensor, Tensor]:
    """Poses after a step; no joint turns by more than 0.6 rad."""
    turns = step[:, 3:].unflatten(1, (-1, 3))
    return R @ rotation.exp(turns * (0.6 / turns.norm(dim=-1, keepdim=True).clamp_min(0.6))), t + step[:, :3]


def _damped(H: Tensor, damping: Tensor) -> Tensor:
    """Cholesky factors of H with its diagonal enlarged (Levenberg-Marquardt)."""
    return torch.linalg.cholesky(H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=1, dim2=2) + 1e-6))


def _solve_poses(body: MarkerBody, seen: _Seen, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Poses from rough ones, each frame with its own damping, until its energy falls by less than 0.1 % in a step."""
    R, t, active = R.clone(), t.clone(), torch.arange(len(t))
    energy, damping = _energy(body, seen, R, t), torch.full_like(t[:, 0], 1e-3)
    for _ in range(25):
        if not len(active):
            break
        part = seen[active]
        g, H, *_ = _model(body, part, R[active], t[active])
        step = torch.cholesky_solve(-g[..., None], _damped(H, damping[active]))[..., 0]
        R_new, t_new = _moved(R[active], t[active], step)
        fallen = energy[active] - _energy(body, part, R_new, t_new)
        better = fallen > 0
        chosen = active[better]
        R[chosen], t[chosen] = R_new[better], t_new[better]
        energy[chosen] -= fallen[better]
        damping[active] *= torch.where(better, 0.2, 8.0)
        active = active[(~better | (fallen > 1e-3 * energy[active])) & (damping[active] < 1e4)]
    return R, t


def _solve_body(body: MarkerBody, seen: _Seen, R: Tensor, t: Tensor) -> tuple[MarkerBody, Tensor, Tensor]:
    """Bones and offsets x with the poses of the frames, from a body that is their prior, until the energy stands."""
    base, count = body.skeleton.t_parent_joint.double(), len(_BONES)
    bones = torch.zeros(count, *base.shape, dtype=torch.float64)
    for bone, (joints, axis, _) in zip(bones, _BONES):
        bone[body.skeleton.indices(*joints), axis] = base[body.skeleton.indices(*joints), axis]
    std = [row[2] for row in _BONES] + [value for name in body.names for value in _ROWS[name][3]]
    prior = torch.tensor(std, dtype=torch.float64) ** -2
    share, damping, x = EVIDENCE / len(t), t.new_tensor([1e-3]), torch.zeros_like(prior)

    def at(x: Tensor) -> MarkerBody:
        skeleton = body.skeleton.with_offsets((base + torch.einsum("k,kjc->jc", x[:count], bones)).float())
        return replace(body, skeleton=skeleton, t_b_marker=body.t_b_marker + x[count:].view(-1, 3))

    def total(x: Tensor, R: Tensor, t: Tensor) -> Tensor:
        return share * _energy(at(x), seen, R, t).sum() + (prior * x * x).sum()

    energy = total(x, R, t)
    for _ in range(60):
        g, H, r, J, root = _model(at(x), seen, R, t)
        J_x = _shared_derivative(at(x), bones, R, t, root)
        solved = torch.cholesky_solve(torch.cat([J.mT @ J_x, g[..., None]], -1), _damped(H, damping))
        S = share * torch.einsum("tra,trb->ab", J_x, J_x) + (prior * (1 + damping)).diag()
        reduced = share * torch.einsum("tra,trb->ab", J_x, J @ solved)
        g_x = share * torch.einsum("tra,tr->a", J_x, r) + prior * x - reduced[:, -1]
        dx = -torch.linalg.solve(S - reduced[:, :-1], g_x)
        R_new, t_new = _moved(R, t, -solved[..., -1] - solved[..., :-1] @ dx)
        fallen = energy - total(x + dx, R_new, t_new)
        damping = damping * (0.2 if fallen > 0 else 8.0)
        if fallen > 0:
            x, R, t, energy = x + dx, R_new, t_new, energy - fallen
            if fallen < 1e-4 * energy:
                break
    return at(x), R, t


def _shared_derivative(
    body: MarkerBody, bones: Float[Tensor, "bone joint 3"], R: Tensor, t: Tensor, root: Float[Tensor, "time marker"]
) -> Float[Tensor, "time row unknown"]:
    """Derivatives of the weighted residuals in the bones' factors, which move all that follows, and in the offsets."""
    skeleton, markers, R_world = body.skeleton, len(body.names), body.places(R, t)[0]
    reach = torch.zeros(markers, len(skeleton), dtype=R.dtype)
    for marker, joint in enumerate(body.a):
        reach[marker, skeleton.ancestors(joint)[:-1]] = 1
    R_parent = R_world[:, [max(parent, 0) for parent in skeleton.parents]]
    lengthened = torch.einsum("mj,tjcd,kjd->tmck", reach, R_parent, bones)
    offset = R.new_zeros(len(root), markers, 3, markers, 3)
    offset[:, range(markers), :, range(markers)] = R_world[:, body.b].transpose(0, 1)
    return (torch.cat([lengthened, offset.flatten(3)], -1) * root[..., None, None]).flatten(1, 2)
