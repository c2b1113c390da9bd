"""A body's motion: size, up axis, sides, knees, joint rotations, feet on the floor, foot contacts."""

import math
from functools import partial

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.body.kinematics import site_positions
from wearcap.body.landmarks import Landmarks, landmarks
from wearcap.body.skeleton import FOOT_PATCHES
from wearcap.checks.report import Check, Finding, has_error
from wearcap.checks.streams import axis_name, check_rotations, check_speed, quantile
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory, interpolate, linear_velocity
from wearcap.io.formats.bvh import HEIGHT_M, REACH_PER_HEIGHT, UNITS_M, longest_path
from wearcap.recording import FloorTrack, Motion


def check_motion(stream: str, motion: Motion, floor: FloorTrack | None) -> list[Finding]:
    """All checks of one motion whose timestamps rise."""
    root = Trajectory(motion.timestamps, motion.R_parent_joint[:, 0], motion.t_world_root)
    findings = [*check_rotations(stream, motion.R_parent_joint), *check_speed(stream, root)]
    check, skeleton = Check(f"{stream}: body size"), motion.skeleton
    height = longest_path(skeleton) / REACH_PER_HEIGHT
    evidence = f"about {height:.3g} m tall by its bones"
    uneven = []
    for name in skeleton.joint_names:
        other = name.replace("left", "right")
        if name.startswith("left") and other in skeleton:
            left, right = (skeleton.t_parent_joint[skeleton.index(joint)].norm() for joint in (name, other))
            if (left - right).abs() > 0.15 * torch.maximum(left, right) + 0.01:
                uneven.append(name)
    if not HEIGHT_M[0] < height < HEIGHT_M[1]:
        unit = min(UNITS_M, key=lambda name: abs(height * UNITS_M[name] - 1.7))
        fix = f"In {unit} it would be {height * UNITS_M[unit]:.2f} m: multiply lengths by {UNITS_M[unit]:.4g}."
        findings.append(check.error("no person's size", evidence, fix))
    elif uneven:
        evidence += f"; {', '.join(uneven)}"
        fix = "Check the subject's measured bone lengths."
        findings.append(check.warning("bones differ left from right", evidence, fix))
    else:
        findings.append(check.ok("a person's size", evidence))
    if has_error(findings):
        return findings
    findings.append(_check_joint_angles(Check(f"{stream}: joint rotations"), motion))
    try:
        parts = landmarks(motion.skeleton)
    except WearcapError as error:
        return [*findings, Check(f"{stream}: skeleton").note("limbs are not recognised by name", str(error))]
    findings += _check_posture(stream, motion, parts)
    if len(motion) > 1 and not has_error(findings):
        findings += _check_axes(Check(f"{stream}: joints' axes"), motion, parts)
    return findings if has_error(findings) else [*findings, *_check_feet(stream, motion, root, parts, floor)]


def _check_joint_angles(check: Check, motion: Motion) -> Finding:
    """Joints are mostly bent little, and no joint turns at impossible speed."""
    R = motion.R_parent_joint[:, 1:]
    usual = math.degrees(quantile(rotation.geodesic(R, torch.eye(3).expand_as(R)), 0.5))
    evidence = f"half of all joint rotations are below {usual:.0f}°"
    if usual > 90:
        wxyz = rotation.quat_wxyz_from_matrix(R)
        fix = "Check quaternion order and units (degrees or radians)."
        for shift, name in ((1, "xyzw"), (-1, "wxyz")):
            angle = 2 * wxyz.roll(shift, -1)[..., 0].abs().clamp(max=1).acos()
            if math.degrees(quantile(angle, 0.5)) < 60:
                fix = f"Read the quaternions as {name}: then they are small."
        return check.error("joints are turned beyond what a body can", evidence, fix)
    if len(motion) > 1:
        spin = rotation.geodesic(R[:-1], R[1:]) / motion.timestamps.diff().to(R.dtype)[:, None]
        flips = spin > 60
        if flips.any():
            names = [motion.skeleton.joint_names[1 + int(joint)] for joint in flips.any(0).nonzero()]
            evidence = f"{int(flips.any(1).sum())} frames above 60 rad/s ({', '.join(names[:4])}); {evidence}"
            severity = "warning" if flips.any(1).double().mean().item() > 0.01 else "note"
            fix = "Euler angles that wrap or a lost marker: filter these frames."
            return check.found(severity, "joints flip within a frame", evidence, fix)
    return check.ok("plausible", evidence)


def _check_posture(stream: str, motion: Motion, parts: Landmarks) -> list[Finding]:
    """Head above feet along z; toes ahead of the ankles, so left and right are not exchanged; knees that bend backwards."""
    check, position = Check(f"{stream}: up axis"), motion.T_world_joint.t.double()
    (left_hip, _, left_ankle), (right_hip, _, right_ankle) = parts.limb["left_leg"], parts.limb["right_leg"]
    upward = position[:, parts.head] - position[:, [left_ankle, right_ankle]].mean(1)
    upward = torch.nn.functional.normalize(upward, dim=-1)
    mean = upward.mean(0)
    evidence = "from feet to head: (" + ", ".join(f"{v:+.2f}" for v in mean.tolist()) + ") of the world, on average"
    if mean[2] < 0.5:
        name = axis_name(mean)
        if mean.abs().max() > 0.8 and not _lies(position, mean):
            fix = f"Read it with up='{name.lstrip('+')}', or turn the world so."
            return [check.error(f"the body stands along {name}", evidence, fix)]
        fix = "Lying, crawling and handstands look like this too."
        findings = [check.warning("the body is not upright", evidence, fix)]
    else:
        findings = [check.ok("z is up", evidence)]
        forward = torch.linalg.cross(position[:, left_hip] - position[:, right_hip], upward)
        toes = [(parts.limb[f"{side}_leg"][2], parts.toe[side]) for side in ("left", "right")]
        ahead = [(forward * (position[:, toe] - position[:, a])).sum(-1) > 0 for a, toe in toes if toe is not None]
        if ahead and torch.stack(ahead).double().mean() < 0.3:
            evidence = "the toes point backwards as seen from the hips"
            fix = "Exchange left and right joints, or undo a mirrored axis."
            return [*findings, Check(f"{stream}: sides").error("left and right are exchanged", evidence, fix)]
    bad, across = [], torch.nn.functional.normalize(position[:, left_hip] - position[:, right_hip], dim=-1)
    for side in ("left", "right"):
        hip, knee, ankle = (position[:, joint] for joint in parts.limb[f"{side}_leg"])
        thigh, shank = (torch.nn.functional.normalize(v, dim=-1) for v in (knee - hip, ankle - knee))
        bent = (thigh * shank).sum(-1) < math.cos(math.radians(25))
        # Flexion rotates the shank about the axis to the left, so thigh × shank points to the right of the body.
        wrong = (torch.linalg.cross(thigh, shank) * across).sum(-1) < -0.2
        if bent.sum() > 10 and (wrong & bent).sum() > 0.3 * bent.sum():
            bad.append(f"{side} ({100 * (wrong & bent).sum() / bent.sum():.0f} % of bent frames)")
    if bad:
        fix = "Check joint axes and rotation order."
        findings.append(Check(f"{stream}: knees").warning("knees bend forwards", ", ".join(bad), fix))
    return findings


def _lies(position: Float64[Tensor, "time joint 3"], along: Float64[Tensor, "3"]) -> bool:
    """Whether the ground that a body keeps to is at z = 0 and not at 0 along the axis from its feet to its head."""
    k = int(along.abs().argmax())
    heights = (position[..., 2].amin(1), (position[..., k] * along[k].sign()).amin(1))
    on_ground, stands = (quantile(h, 0.05) > -0.25 and quantile(h, 0.95) < 0.25 for h in heights)
    return on_ground and not stands


def _check_axes(check: Check, motion: Motion, parts: Landmarks) -> list[Finding]:
    """Pelvis, trunk and head are upright and face where the body does, in frames in which it stands.

    A head may look down; hips and shoulders show where pelvis and trunk face, and all three the way while it walks on.
    """
    T, root = motion.T_world_joint, Trajectory(motion.timestamps, motion.R_parent_joint[:, 0], motion.t_world_root)
    t, unit = T.t.double(), partial(torch.nn.functional.normalize, dim=-1)
    (hip, knee, ankle), (shoulder, *_) = (
        t[:, [[parts.limb[f"{side}_{part}"][k] for side in ("left", "right")] for k in range(3)]].unbind(1)
        for part in ("leg", "arm")
    )
    legs = ((hip - knee).norm(dim=-1) + (knee - ankle).norm(dim=-1)).mean(1)
    upward = (unit(shoulder.mean(1) - hip.mean(1)), unit(t[:, parts.head] - shoulder.mean(1)))
    stands = ((hip - ankle).mean(1)[:, 2] > 0.85 * legs) & (upward[0][:, 2] > 0.95) & (upward[1][:, 2] > 0.8)
    if stands.sum() < 10:
        return []
    across = [unit(pair[:, 0] - pair[:, 1]) for pair in (hip, shoulder)]
    way = unit(linear_velocity(root).double() * torch.tensor([1.0, 1.0, 0.0]))
    ahead = torch.linalg.cross(across[0], upward[0])
    walks = stands & (linear_velocity(root).norm(dim=-1) > 0.5) & ((ahead * way).sum(-1) > 0.9)
    evidence, severity = [], 0
    limits = (("pelvis", parts.root, 0.8, 0.5), ("trunk", parts.spine[-1], 0.75, 0.5), ("head", parts.head, 0.3, 0.3))
    for name, joint, least_up, least_ahead in limits:
        R = T.R[:, joint].double()
        up, aside = R[stands, 2, 2].mean().item(), R[stands, 2, 1].mean().abs().item()
        if joint != parts.head:
            faces = (R[..., 1] * across[joint != parts.root]).sum(-1)[stands].mean().item()
        else:
            faces = quantile((R[walks, :, 0] * way[walks]).sum(-1), 0.5) if walks.sum() >= 10 else 1.0
        if up < least_up + 0.05 or aside > 0.5 or faces < least_ahead + 0.15:
            evidence.append(f"{name} up by {up:.2f}, ahead by {faces:.2f} of 1")
            severity = max(severity, 2 if up < least_up or aside > 0.75 or faces < least_ahead else 1)
    if not severity:
        return [check.ok("pelvis, trunk and head are upright and ahead", f"in {int(stands.sum())} frames that stand")]
    fix = "The axes of its joints are not x ahead, z up: read the file that they come from, with its skeleton's other clips."
    finding = (check.warning, check.error)[severity - 1]
    return [finding("joints' axes are not the body's", f"while it stands, {'; '.join(evidence)}", fix)]


def _check_feet(
    stream: str, motion: Motion, root: Trajectory, parts: Landmarks, floor: FloorTrack | None
) -> list[Finding]:
    """The lowest foot is at the floor, and stands still while it is.

    A foot's points are heels and toe tips, or ankles and toe joints of a skeleton without these sites.
    """
    if all(patch in motion.skeleton.sites for patch in FOOT_PATCHES):
        feet = site_positions(motion.skeleton, motion.T_world_joint, FOOT_PATCHES).double()
    else:
        ankles = [parts.limb[f"{side}_leg"][2] for side in ("left", "right")]
        joints = [joint for joint in (*ankles, *parts.toe.values()) if joint is not None]
        feet = motion.T_world_joint.t[:, joints].double()
    ground = torch.zeros(len(motion), dtype=torch.float64)
    if floor is not None:
        times = motion.timestamps.clamp(floor.timestamps[0].item(), floor.timestamps[-1].item())
        ground = interpolate(floor.timestamps, floor.height.double(), times)
    check, lowest = Check(f"{stream}: feet on the floor"), (feet[..., 2] - ground[:, None]).amin(1)
    low, usual = quantile(lowest, 0.1), quantile(lowest, 0.5)
    evidence = (
        f"the lowest foot point is at {100 * low:+.1f} cm in its lowest tenth, {100 * usual:+.1f} cm in the median"
    )
    if abs(usual) <= 0.1 and low >= -0.1:
        found = check.ok("feet meet the floor", evidence)
    elif floor is None:
        found = check.note("the floor is not at z = 0", evidence, "Give the recording a floor, or move the world.")
    else:
        where = "sink into" if low < -0.1 else "float above" if usual > 0.1 else "are below"
        found = check.warning(f"feet {where} the floor", evidence, "Check the floor's height and the foot's size.")
    near = (lowest - quantile(lowest, 0.05)).abs() < 0.03
    if len(motion) < 30 or near.sum() < 20:
        return [found]
    R = torch.eye(3, dtype=torch.float64).expand(len(feet), 3, 3)
    tracks = [Trajectory(motion.timestamps, R, feet[:, point]) for point in range(feet.shape[1])]
    speed = torch.stack([linear_velocity(track) for track in tracks], 1)
    speed = speed[torch.arange(len(feet)), feet[..., 2].argmin(1), :2].norm(dim=-1)  # of the lowest point
    slide = 100 * quantile(speed[near], 0.5)
    check, pace = Check(f"{stream}: foot sliding"), 100 * quantile(linear_velocity(root)[:, :2].norm(dim=-1), 0.5)
    if slide > max(20.0, 0.15 * pace):
        evidence = f"{slide:.0f} cm/s while within 3 cm of the floor (half of the frames)"
        fix = "Frame rate, unit of the root's path, or legs' lengths may be wrong."
        return [found, check.warning("standing feet slide", evidence, fix)]
    return [found, check.ok("standing feet stand", f"{slide:.1f} cm/s in the median")]


def check_contact_prob(stream: str, motion: Motion) -> list[Finding]:
    """Foot contacts have one row per pose, are probabilities, and are neither always nor never present."""
    contact, check = motion.contact_prob, Check(f"{stream}: contacts")
    if contact is None:
        return []
    if len(contact) != len(motion):
        what = f"contacts are {'shorter' if len(contact) < len(motion) else 'longer'} than poses"
        evidence = f"{len(contact)} rows for {len(motion)} poses"
        return [check.error(what, evidence, "Cut or resample both together.")]
    if not ((contact >= 0) & (contact <= 1)).all():
        evidence = f"{contact.min():.3g} … {contact.max():.3g}"
        return [check.error("contacts are no probabilities", evidence, "Values from 0 to 1.")]
    share = (contact > 0.5).float().mean().item()
    evidence = f"a part of a foot touches the ground {100 * share:.0f} % of the time"
    if not 0.02 < share < 0.98:
        fix = "Check the contacts' columns: heel and toe of the left, then of the right foot."
        return [check.warning("feet never touch" if share < 0.5 else "feet never lift", evidence, fix)]
    return [check.ok("feet touch and lift", evidence)]
