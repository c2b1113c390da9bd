"""A person who walks round a circle with planted feet, as a function of time: exact truth for tests of plausibility."""

import torch

from wearcap.body.kinematics import forward_kinematics, local_rotations
from wearcap.body.retarget import reach
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis, exp, log
from wearcap.recording import ContactTrack, FloorTrack, HeadStream, ImuStream, Motion, PointCloud, Recording

SPEED, RADIUS, CYCLE, STANCE, ANKLE = 1.1, 3.0, 1.1, 0.6, 0.08
SEAT = Rigid(torch.eye(3), torch.tensor([0.09, 0.0, 0.075]))
MOUNT = exp(torch.tensor([0.3, -0.2, 1.0]))
"""R_joint_imu of every sensor."""


def track(time, aside):
    """Position on the circle `aside` metres to the left of its middle, and heading."""
    angle = SPEED / RADIUS * time
    radius = RADIUS - aside
    return torch.stack([radius * angle.cos(), radius * angle.sin(), 0 * angle], -1), angle + torch.pi / 2


def foot(time, aside, phase):
    """Ankle position and foot heading: still during stance, a lifted step between."""
    cycle = time / CYCLE + phase
    place, part = cycle.floor(), cycle % 1
    swing = ((part - STANCE) / (1 - STANCE)).clamp(0, 1)
    blend = swing * swing * (3 - 2 * swing)
    middle = (place + STANCE / 2 - phase) * CYCLE
    (here, heading), (there, next_heading) = track(middle, aside), track(middle + CYCLE, aside)
    position = torch.lerp(here, there, blend[:, None])
    lift = torch.stack([0 * time, 0 * time, ANKLE + 0.1 * (torch.pi * blend).sin() ** 2], -1)
    return position + lift, torch.lerp(heading, next_heading, blend), part < STANCE


def walk(time):
    """Motion and foot contacts at these times (s)."""
    skeleton = xsens23()
    root, heading = track(time, 0.0)
    root = root + torch.stack(
        [0 * time, 0 * time, skeleton.root_height - 0.05 + 0.015 * (4 * torch.pi * time / CYCLE).cos()], -1
    )
    R_world = about_axis("z", heading)[:, None].expand(-1, len(skeleton), 3, 3).clone()
    swing = 0.4 * (2 * torch.pi * time / CYCLE).sin()
    look = (
        about_axis("z", 0.5 * (0.8 * time).sin())
        @ about_axis("y", 0.15 + 0.15 * (1.7 * time).sin())
        @ about_axis("x", 0.1 * (2.3 * time).sin())
    )
    R_world[:, skeleton.index("head")] = R_world[:, 0] @ look
    for side, sign in (("left", 1), ("right", -1)):
        hang = about_axis("y", sign * swing) @ about_axis("x", torch.full_like(time, -sign * 1.4))
        for joint in ("shoulder", "elbow", "wrist"):
            R_world[:, skeleton.index(f"{side}_{joint}")] = R_world[:, 0] @ hang
    joints = forward_kinematics(skeleton, local_rotations(skeleton, R_world), root)
    contact = []
    for side, phase in (("left", 0.0), ("right", 0.5)):
        names = [skeleton.index(f"{side}_{joint}") for joint in ("hip", "knee", "ankle", "toe")]
        bent = about_axis("y", torch.full_like(time, 0.2))
        thigh, shank = R_world[:, 0] @ bent.mT, R_world[:, 0] @ bent
        hip = joints.t[:, names[0]]
        knee = hip + (thigh @ skeleton.t_parent_joint[names[1]].double())
        ankle = knee + (shank @ skeleton.t_parent_joint[names[2]].double())
        goal, turn, planted = foot(time, 0.085 if side == "left" else -0.085, phase)
        upper, lower = reach(hip, knee, ankle, goal)
        R_world[:, names[0]], R_world[:, names[1]] = upper @ thigh, lower @ shank
        R_world[:, names[2]] = R_world[:, names[3]] = about_axis("z", turn)
        contact += [planted, planted]
    motion = Motion(time, skeleton, local_rotations(skeleton, R_world).float(), root.float())
    return motion, torch.stack(contact, 1)


def inertial(joint, seconds, rate=120.0):
    """A perfect sensor on a joint."""
    fine = 1 / 960
    time = torch.arange(int(seconds * rate), dtype=torch.float64) / rate
    before, here, after = (double(walk(time + shift)[0].joint(joint)) for shift in (-fine, 0.0, fine))
    acc_world = (before.t + after.t - 2 * here.t) / fine**2
    R_world_imu = here.R @ MOUNT.double()
    gyro = log((before.R @ MOUNT.double()).mT @ (after.R @ MOUNT.double())) / (2 * fine)
    up = torch.tensor([0.0, 0.0, 9.81], dtype=torch.float64)
    acc_imu = (R_world_imu.mT @ (acc_world + up)[..., None])[..., 0]
    return ImuStream(time, joint, R_world_imu.float(), acc_world.float(), acc_imu.float(), gyro.float(), MOUNT)


def double(pose):
    return Rigid(pose.R.double(), pose.t.double())


def room(seed=0):
    random = torch.Generator().manual_seed(seed)
    floor = 9 * torch.rand(4000, 3, generator=random) - 4.5
    floor[:, 2] = 0.01 * torch.randn(4000, generator=random)
    wall = 9 * torch.rand(4000, 3, generator=random) - 4.5
    wall[:, 0], wall[:, 2] = 4.5, 2.5 * torch.rand(4000, generator=random)
    return PointCloud(torch.cat([floor, wall]))


def sound_recording(seconds=24.0, fps=60.0):
    time = torch.arange(int(seconds * fps), dtype=torch.float64) / fps
    motion, contact = walk(time)
    T_world_device = motion.joint("head") @ SEAT
    return Recording(
        "walk",
        head=HeadStream(time, T_world_device.R, T_world_device.t, SEAT.R, SEAT.t),
        motion=motion,
        imu={"left_wrist": inertial("left_wrist", seconds), "head": inertial("head", seconds)},
        points=room(),
        contacts=ContactTrack(time, FOOT_PATCHES, contact),
        floor=FloorTrack(time, torch.zeros(len(time))),
        skeleton=motion.skeleton,
    )
