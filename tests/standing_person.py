"""A person who stands, raises the left hand and walks, with devices whose seats, headings and clocks are planted."""

import math
from dataclasses import dataclass, field

import torch

from wearcap.apps.live.clock_offset import Aligned
from wearcap.apps.live.setup_estimation import SetupEstimation
from wearcap.body.skeleton import skeleton_of_height
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import about_axis, exp
from wearcap.recording import Motion
from wearcap.sensors.imu import synthesize_imu
from wearcap.sensors.samples import HeadSample, WatchSample, WristSample

FPS = 60.0
TURN_S = 4.0
PRONATED_RAD = 0.3
"""Angle by which the palms of hanging arms face backwards, as people's do."""


def acting(height_m: float, plan: list[tuple[str, float]], heading: float = 0.7, head_leads_s: float = 0.0) -> Motion:
    """Someone who does "stand", "raise" (the left hand), "walk" or "turn" (to the left and back in `TURN_S`) for some
    seconds each. The head may turn before the body."""
    skeleton = skeleton_of_height(height_m)
    acts = [act for act, seconds in plan for _ in range(round(FPS * seconds))]
    times = torch.arange(len(acts), dtype=torch.float64) / FPS
    walks = torch.tensor([act == "walk" for act in acts]).double()
    raises = torch.tensor([act == "raise" for act in acts]).double()
    local = torch.cat([torch.arange(round(FPS * seconds)) for _, seconds in plan]) / FPS
    turns = torch.tensor([act == "turn" for act in acts]) * (2 * torch.pi * local.double() / TURN_S).sin()
    blend = torch.hann_window(31, periodic=False, dtype=torch.float64)
    walks, raises, turns = (
        torch.nn.functional.conv1d(one[None, None], blend[None, None] / blend.sum(), padding=15)[0, 0]
        for one in (walks, raises, turns)
    )
    yaw = heading + (1.6 * turns).cumsum(0) / FPS
    lead = round(head_leads_s * FPS)
    way = (1.1 * walks).cumsum(0) / FPS
    swing = (0.45 * walks * (2 * torch.pi * 0.9 * times).sin()).float()
    R = torch.eye(3).repeat(len(acts), len(skeleton), 1, 1)
    R[:, 0] = about_axis("z", yaw).float()
    R[:, skeleton.index("head")] = about_axis("z", torch.cat([yaw[lead:], yaw[-1:].repeat(lead)]) - yaw).float()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        up = (1.4 * raises * (sign > 0)).float()
        down = about_axis("x", torch.tensor(-sign * 1.45))
        R[:, skeleton.index(f"{side}_shoulder")] = about_axis("y", -sign * swing - up) @ down
        R[:, skeleton.index(f"{side}_elbow")] = about_axis("z", torch.full_like(swing, -sign * 0.15))
        R[:, skeleton.index(f"{side}_wrist")] = about_axis("y", torch.tensor(PRONATED_RAD))
        R[:, skeleton.index(f"{side}_hip")] = about_axis("y", sign * swing)
    root = torch.stack([way * math.cos(heading), way * math.sin(heading), 0 * way + skeleton.root_height], -1).float()
    root[:, 2] += 0.01 * (walks * (4 * torch.pi * 0.9 * times).sin()).float()
    return Motion(times, skeleton, R, root)


@dataclass
class Devices:
    """Planted seats of head and hands, and the noise."""

    T_head_device: Rigid = field(default_factory=lambda: Rigid(torch.eye(3), torch.tensor([0.09, 0.0, 0.075])))
    floor_m: float = 0.0
    names: tuple[str, str] = ("left_wrist", "right_wrist")
    T_wrist_device: tuple[Rigid, Rigid] = (Rigid.identity(), Rigid.identity())
    """Of tracked hands or watches, left and right."""
    yaw_rad: tuple[float, float] = (0.0, 0.0)
    """Turn from each watch's world to the head's."""
    watches: bool = False
    noise_m: float = 0.001
    noise_deg: float = 0.3
    batch_s: float = 0.0
    """Time (s) of hands' samples that come at once."""
    offset_s: tuple[float, float] = (0.0, 0.0)
    """Seconds to add to each watch's times; until they are, its samples count and come as late or early."""
    aligned: dict[str, Aligned] = field(default_factory=dict)
    """What the first minute found of clocks; from then on samples count it."""
    now_s: float = 5.0
    """Our time; it goes on from one play to the next."""

    def play(self, motion: Motion, first: SetupEstimation, begin_s: float = 100.0, until_s: float = math.inf) -> float:
        """Show the samples to a first minute until it is done; returns the seconds it took."""
        random = torch.Generator().manual_seed(3)
        shift = Rigid(torch.eye(3), torch.tensor([0.4, -1.0, self.floor_m]))
        head = shift @ motion.joint("head") @ self.T_head_device
        hands = [self._hand(motion, shift, side) for side in (0, 1)]
        waiting: list[tuple[str, WristSample | WatchSample]] = []
        for frame, time_s in enumerate(motion.timestamps.tolist()):
            if first.found is not None or time_s > until_s:
                return time_s
            self.now_s += 1 / FPS
            at_s = begin_s + time_s
            first.see("head", HeadSample(at_s, self._noisy(head[frame], random)), self.now_s)
            for name, offset_s, (pose, acc) in zip(self.names, self.offset_s, hands):
                if not name:
                    continue
                measured = min(max(frame + round(offset_s * FPS), 0), len(motion) - 1)
                noisy = self._noisy(pose[measured], random)
                sample = WristSample(name, at_s, noisy)
                if self.watches:
                    sample = WatchSample(at_s, noisy.R, acc[measured] + 0.05 * torch.randn(3, generator=random), name)
                waiting.append((name, sample))
            if not waiting or at_s - waiting[0][1].timestamp >= self.batch_s:
                for name, sample in waiting:
                    found = self.aligned.get(name)
                    time_s = sample.timestamp + (0.0 if found is None else found.offset_s)
                    first.see(name, sample._replace(timestamp=time_s), self.now_s)
                waiting.clear()
            self.aligned |= {each.device: each for each in first.aligned}
            first.aligned.clear()
        return math.inf

    def _hand(self, motion: Motion, shift: Rigid, side: int) -> tuple[Rigid, torch.Tensor]:
        joint = ("left_wrist", "right_wrist")[side]
        pose = shift @ motion.joint(joint) @ self.T_wrist_device[side]
        acc = synthesize_imu(motion, joint).acc_world
        assert acc is not None
        if not self.watches:
            return pose, acc
        turn = about_axis("z", torch.tensor(-self.yaw_rad[side]))
        return Rigid(turn @ pose.R, pose.t), acc @ turn.mT

    def _noisy(self, pose: Rigid, random: torch.Generator) -> Rigid:
        turn = exp(math.radians(self.noise_deg) * torch.randn(3, generator=random))
        return Rigid(pose.R @ turn, pose.t + self.noise_m * torch.randn(3, generator=random))
