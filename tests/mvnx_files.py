"""MVNX files, written here as MVN Analyze exports them."""

import numpy as np
import torch

from wearcap.body.skeleton import xsens23
from wearcap.geometry import rotation
from wearcap.recording import Motion

SEGMENTS = {
    "Pelvis": "pelvis",
    "L5": "l5",
    "L3": "l3",
    "T12": "t12",
    "T8": "t8",
    "Neck": "neck",
    "Head": "head",
    **{
        side + segment: f"{side.lower()}_{joint}"
        for side, segments in (
            ("Right", ("Shoulder", "UpperArm", "ForeArm", "Hand")),
            ("Left", ("Shoulder", "UpperArm", "ForeArm", "Hand")),
            ("Right", ("UpperLeg", "LowerLeg", "Foot", "Toe")),
            ("Left", ("UpperLeg", "LowerLeg", "Foot", "Toe")),
        )
        for segment, joint in zip(
            segments,
            ("collar", "shoulder", "elbow", "wrist") if "Hand" in segments else ("hip", "knee", "ankle", "toe"),
        )
    },
}
SENSORS = ["Pelvis", "T8", "Head", "LeftForeArm", "RightForeArm", "LeftLowerLeg", "Prop1"]
CONTACTS = ["LeftFoot_Heel", "LeftFoot_Toe", "RightFoot_Heel", "RightFoot_Toe"]
POINTS = {
    "LeftFoot": ("pLeftHeelFoot", "-0.06 0 -0.05"),
    "Head": ("pTopOfHead", "0 0 0.2"),
    "LeftToe": ("pLeftToe", "0.05 0 0"),
}
IDENTITY = "1 0 0 0 "


def numbers(values) -> str:
    return " ".join(f"{v:.9f}" for v in np.asarray(values).reshape(-1))


def sample(frames: int = 6) -> Motion:
    generator = torch.Generator().manual_seed(8)
    skeleton = xsens23().scaled(1.04)
    R = rotation.exp(0.5 * torch.randn(frames, 23, 3, generator=generator))
    contact = (torch.rand(frames, 4, generator=generator) > 0.5).float()
    return Motion(
        torch.arange(frames, dtype=torch.float64) / 240,
        skeleton,
        R,
        torch.randn(frames, 3, generator=generator),
        contact,
    )


def sensors(frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(9)
    acc = torch.randn(frames, len(SENSORS), 3, generator=generator)
    return acc, rotation.exp(torch.randn(frames, len(SENSORS), 3, generator=generator))


def mvnx(motion: Motion, rest: str = "identity", contacts: list[str] = CONTACTS) -> str:
    order = motion.skeleton.indices(*SEGMENTS.values())
    poses, (acc, R_sensor) = motion.T_world_joint, sensors(len(motion))
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<mvnx version="4" xmlns="http://www.xsens.com/mvn/mvnx">',
        '<mvn version="2022.0.0" build="x"/><comment/>',
        f'<subject label="Suit" frameRate="240" segmentCount="{len(SEGMENTS)}" configuration="FullBody"><segments>',
    ]
    for k, label in enumerate(SEGMENTS, 1):
        point = (
            f'<point label="{POINTS[label][0]}"><pos_b>{POINTS[label][1]}</pos_b></point>' if label in POINTS else ""
        )
        lines.append(f'<segment label="{label}" id="{k}"><points>{point}</points></segment>')
    lines += [
        "</segments><sensors>",
        *(f'<sensor label="{label}"/>' for label in SENSORS),
        "</sensors>",
        '<joints><joint label="jL5S1"><connector1>Pelvis/jL5S1</connector1></joint></joints><footContactDefinition>',
        *(f'<contactDefinition label="{label}" index="{k}"/>' for k, label in enumerate(contacts)),
        '</footContactDefinition><frames segmentCount="23" sensorCount="7" jointCount="22">',
    ]
    rest_joints = motion.skeleton.rest_joints[order]
    if rest:
        lines.append(
            f'<frame time="0" index="" tc="00:00:00:00" ms="0" type="{rest}"><orientation>{IDENTITY * 23}</orientation>'
            f"<position>{numbers(rest_joints)}</position></frame>"
        )
        lines.append('<frame type="tpose-isb"><orientation>what else</orientation></frame>')
    patches = ["LeftFoot_Heel", "LeftFoot_Toe", "RightFoot_Heel", "RightFoot_Toe"]
    for k in range(len(motion)):
        contact = motion.contact_prob[k, [patches.index(label) for label in contacts or patches]]
        lines.append(
            f'<frame time="{round(1000 * k / 240)}" index="{k}" tc="" ms="1" type="normal">'
            f"<orientation>{numbers(rotation.quat_wxyz_from_matrix(poses.R[k, order].double()))}</orientation>"
            f"<position>{numbers(poses.t[k, order])}</position><velocity>0 0 0</velocity>"
            f"<footContacts>{' '.join(str(int(c)) for c in contact)}</footContacts>"
            f"<sensorFreeAcceleration>{numbers(acc[k])}</sensorFreeAcceleration>"
            f"<sensorOrientation>{numbers(rotation.quat_wxyz_from_matrix(R_sensor[k].double()))}</sensorOrientation></frame>"
        )
    return "\n".join([*lines, "</frames></subject></mvnx>"])
