"""A body's motion: size, up axis, sides, knees, joint rotations, feet on the floor."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.body.landmarks import Landmarks, landmarks
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.doctor.poses import check_rotations, check_speed
from wearcap.doctor.report import Finding
from wearcap.doctor.signals import quantile
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, interpolate, linear_velocity
from wearcap.io.formats.bvh import HEIGHT_M, REACH_PER_HEIGHT, UNITS_M, longest_path
from wearcap.recording import FloorTrack, Motion


def check_motion(stream: str, motion: Motion, floor: FloorTrack | None) -> list[Finding]:
    """All checks of one motion whose timestamps rise."""
    findings = check_rotations(stream, motion.R_parent_joint)
    findings += check_speed(stream, Trajectory(motion.timestamps, motion.R_parent_joint[:, 0], motion.t_world_root))
    findings += check_size(stream, motion.skeleton)
    if any(finding.severity == "error" for finding in findings):
        return findings
    findings += check_joint_angles(stream, motion)
    try:
        parts = landmarks(motion.skeleton)
    except WearcapError as error:
        return [*findings, Finding("note", f"{stream}: skeleton", "limbs are not recognised by name", str(error))]
    findings += check_posture(stream, motion, parts)
    if any(finding.severity == "error" for finding in findings):
        return findings
    return findings + check_knees(stream, motion, parts) + check_feet(stream, motion, parts, floor)


def _root(motion: Motion) -> Trajectory:
    return Trajectory(motion.timestamps, motion.R_parent_joint[:, 0], motion.t_world_root)


def check_size(stream: str, skeleton: Skeleton) -> list[Finding]:
    """A person's size, the same left and right."""
    check = f"{stream}: body size"
    height = longest_path(skeleton) / REACH_PER_HEIGHT
    evidence = f"about {height:.3g} m tall by its bones"
    if not HEIGHT_M[0] < height < HEIGHT_M[1]:
        unit = min(UNITS_M, key=lambda name: abs(height * UNITS_M[name] - 1.7))
        fix = f"In {unit} it would be {height * UNITS_M[unit]:.2f} m: multiply lengths by {UNITS_M[unit]:.4g}."
        return [Finding("error", check, "no person's size", evidence, fix)]
    lengths = skeleton.t_parent_joint.norm(dim=-1)
    pairs = [(name, name.replace("left", "right")) for name in skeleton.joint_names if name.startswith("left")]
    uneven = [
        left
        for left, right in pairs
        if right in skeleton and _differ(lengths[skeleton.index(left)], lengths[skeleton.index(right)])
    ]
    if uneven:
        return [
            Finding(
                "warning",
                check,
                "bones differ left from right",
                f"{evidence}; {', '.join(uneven)}",
                "Check the subject's measured bone lengths.",
            )
        ]
    return [Finding("ok", check, "a person's size", evidence)]


def _differ(left: Tensor, right: Tensor) -> bool:
    return bool((left - right).abs() > 0.15 * torch.maximum(left, right) + 0.01)


def check_joint_angles(stream: str, motion: Motion) -> list[Finding]:
    """Joints are mostly bent little, and no joint turns at impossible speed."""
    check = f"{stream}: joint rotations"
    R = motion.R_parent_joint[:, 1:]
    usual = math.degrees(quantile(rotation.geodesic(R, torch.eye(3).expand_as(R)), 0.5))
    evidence = f"half of all joint rotations are below {usual:.0f}°"
    if usual > 90:
        wxyz = rotation.quat_wxyz_from_matrix(R)
        order = None
        for shift, name in ((1, "xyzw"), (-1, "wxyz")):
            angle = 2 * wxyz.roll(shift, -1)[..., 0].abs().clamp(max=1).acos()
            order = name if math.degrees(quantile(angle, 0.5)) < 60 else order
        fix = (
            f"Read the quaternions as {order}: then they are small."
            if order
            else "Check quaternion order and units (degrees or radians)."
        )
        return [Finding("error", check, "joints are turned beyond what a body can", evidence, fix)]
    if len(motion) > 1:
        spin = rotation.geodesic(R[:-1], R[1:]) / motion.timestamps.diff().to(R.dtype)[:, None]
        flips = spin > 60
        if flips.any():
            names = [motion.skeleton.joint_names[1 + int(joint)] for joint in flips.any(0).nonzero()]
            share = flips.any(1).double().mean().item()
            return [
                Finding(
                    "warning" if share > 0.01 else "note",
                    check,
                    "joints flip within a frame",
                    f"{int(flips.any(1).sum())} frames above 60 rad/s ({', '.join(names[:4])}); {evidence}",
                    "Euler angles that wrap or a lost marker: filter these frames.",
                )
            ]
    return [Finding("ok", check, "plausible", evidence)]


def check_posture(stream: str, motion: Motion, parts: Landmarks) -> list[Finding]:
    """Head above feet along z; toes ahead of the ankles, so left and right are not exchanged."""
    position = motion.T_world_joint.t.double()
    (left_hip, _, left_ankle), (right_hip, _, right_ankle) = parts.limb["left_leg"], parts.limb["right_leg"]
    upward = position[:, parts.head] - position[:, [left_ankle, right_ankle]].mean(1)
    upward = torch.nn.functional.normalize(upward, dim=-1)
    mean, check = upward.mean(0), f"{stream}: up axis"
    evidence = "from feet to head: (" + ", ".join(f"{v:+.2f}" for v in mean.tolist()) + ") of the world, on average"
    if mean[2] < 0.5:
        axis = int(mean.abs().argmax())
        name = ("-" if mean[axis] < 0 else "+") + "xyz"[axis]
        clear = bool(mean.abs().max() > 0.8)
        fix = (
            f"Read it with up='{name.lstrip('+')}', or turn the world so."
            if clear
            else "Lying, crawling and handstands look like this too."
        )
        severity = "error" if clear else "warning"
        return [
            Finding(
                severity, check, f"the body stands along {name}" if clear else "the body is not upright", evidence, fix
            )
        ]
    findings = [Finding("ok", check, "z is up", evidence)]
    forward = torch.linalg.cross(position[:, left_hip] - position[:, right_hip], upward)
    toes = [(parts.limb[f"{side}_leg"][2], parts.toe[side]) for side in ("left", "right")]
    ahead = [(forward * (position[:, toe] - position[:, ankle])).sum(-1) > 0 for ankle, toe in toes if toe is not None]
    if ahead and torch.stack(ahead).double().mean() < 0.3:
        findings.append(
            Finding(
                "error",
                f"{stream}: sides",
                "left and right are exchanged",
                "the toes point backwards as seen from the hips",
                "Exchange left and right joints, or undo a mirrored axis.",
            )
        )
    return findings


def check_knees(stream: str, motion: Motion, parts: Landmarks) -> list[Finding]:
    """Knees bend backwards."""
    position, bad = motion.T_world_joint.t.double(), []
    across = position[:, parts.limb["left_leg"][0]] - position[:, parts.limb["right_leg"][0]]
    for side in ("left", "right"):
        hip, knee, ankle = (position[:, joint] for joint in parts.limb[f"{side}_leg"])
        thigh, shank = (torch.nn.functional.normalize(v, dim=-1) for v in (knee - hip, ankle - knee))
        bent = (thigh * shank).sum(-1) < math.cos(math.radians(25))
        # Flexion rotates the shank about the axis to the left, so thigh × shank points to the right of the body.
        wrong = (torch.linalg.cross(thigh, shank) * torch.nn.functional.normalize(across, dim=-1)).sum(-1) < -0.2
        if bent.sum() > 10 and (wrong & bent).sum() > 0.3 * bent.sum():
            bad.append(f"{side} ({100 * (wrong & bent).sum() / bent.sum():.0f} % of bent frames)")
    if bad:
        return [
            Finding(
                "warning",
                f"{stream}: knees",
                "knees bend forwards",
                ", ".join(bad),
                "Check joint axes and rotation order.",
            )
        ]
    return []


def check_feet(stream: str, motion: Motion, parts: Landmarks, floor: FloorTrack | None) -> list[Finding]:
    """The lowest foot is at the floor, and stands still while it is."""
    feet = _foot_points(motion, parts)
    height = feet[..., 2] - _floor_at(floor, motion)[:, None]
    check, lowest = f"{stream}: feet on the floor", height.amin(1)
    low, usual = quantile(lowest, 0.1), quantile(lowest, 0.5)
    evidence = (
        f"the lowest foot point is at {100 * low:+.1f} cm in its lowest tenth, {100 * usual:+.1f} cm in the median"
    )
    findings = []
    if floor is None and (abs(usual) > 0.1 or low < -0.1):
        findings.append(
            Finding(
                "note", check, "the floor is not at z = 0", evidence, "Give the recording a floor, or move the world."
            )
        )
    elif abs(usual) > 0.1 or low < -0.1:
        where = "sink into" if low < -0.1 else "float above" if usual > 0.1 else "are below"
        findings.append(
            Finding(
                "warning", check, f"feet {where} the floor", evidence, "Check the floor's height and the foot's size."
            )
        )
    else:
        findings.append(Finding("ok", check, "feet meet the floor", evidence))
    if len(motion) < 30:
        return findings
    slide = _sliding_cm_s(motion, feet, lowest)
    pace = 100 * quantile(linear_velocity(_root(motion))[:, :2].norm(dim=-1), 0.5)
    if slide is not None and slide > max(20.0, 0.15 * pace):
        findings.append(
            Finding(
                "warning",
                f"{stream}: foot sliding",
                "standing feet slide",
                f"{slide:.0f} cm/s while within 3 cm of the floor (half of the frames)",
                "Frame rate, unit of the root's path, or legs' lengths may be wrong.",
            )
        )
    elif slide is not None:
        findings.append(
            Finding("ok", f"{stream}: foot sliding", "standing feet stand", f"{slide:.1f} cm/s in the median")
        )
    return findings


def _foot_points(motion: Motion, parts: Landmarks) -> Float[Tensor, "time point 3"]:
    """Heels and toe tips, or ankles and toe joints of a skeleton without these sites."""
    if all(patch in motion.skeleton.sites for patch in FOOT_PATCHES):
        return site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double()
    ankles = [parts.limb[f"{side}_leg"][2] for side in ("left", "right")]
    joints = [joint for joint in (*ankles, *parts.toe.values()) if joint is not None]
    return motion.T_world_joint.t[:, joints].double()


def _floor_at(floor: FloorTrack | None, motion: Motion) -> Float[Tensor, "time"]:
    if floor is None:
        return torch.zeros(len(motion), dtype=torch.float64)
    times = motion.timestamps.clamp(floor.timestamps[0].item(), floor.timestamps[-1].item())
    return interpolate(floor.timestamps, floor.height.double(), times)


def _sliding_cm_s(motion: Motion, feet: Tensor, lowest: Tensor) -> float | None:
    """Median horizontal speed of the lowest foot point while it is near its usual lowest height; None if hardly ever."""
    point = feet[..., 2].argmin(1)
    near = (lowest - quantile(lowest, 0.05)).abs() < 0.03
    if near.sum() < 20:
        return None
    R = torch.eye(3, dtype=torch.float64).expand(len(feet), 3, 3)
    speed = torch.stack(
        [linear_velocity(Trajectory(motion.timestamps, R, feet[:, i])) for i in range(feet.shape[1])], 1
    )
    lowest_speed = speed[torch.arange(len(point)), point, :2].norm(dim=-1)
    return 100 * quantile(lowest_speed[near], 0.5)
