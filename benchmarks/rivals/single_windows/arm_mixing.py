"""Arms of one clip with the rest of another where their trunks agree: few recorded motions become more (ours).

A motion is divided into segments of some seconds. For each, other recordings are searched for a moment at which the trunk
leans, bends, turns and moves alike, and the arms do what they did there, blended from segment to segment. Where no
trunk agrees, the arms stay as recorded. Legs, trunk and head are never changed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics
from wearcap.geometry import rotation
from wearcap.recording import Motion
from wearcap.recording.store import RecordingFile

ARMS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ("collar", "shoulder", "elbow", "wrist"))
"""Joints whose rotations are exchanged."""
_RATE = 10.0
"""Rate (Hz) at which trunks are compared."""
_TOLERANCES = (0.25,) * 3 + (1.0,) * 3 + (0.35,) * 3 + (0.5,) * 3
"""Differences between two trunks that weigh 1 each, in the order of `_trunk`: 1, rad/s, rad, m/s."""
_CANDIDATES = 5
"""Number of recordings with the best agreement of which one is drawn."""
_LENGTHS_S = 1.5, 3.0
"""Shortest and longest segment (s); what is left at the end belongs to the last one."""


@dataclass(frozen=True)
class _Segment:
    """Frames of a motion with the arms of frames of a donor, which begin at `at`; None: its own."""

    start: int
    stop: int
    donor: int | None
    at: int = 0


class ArmDonors:
    """Recordings whose arms others may move, with the way in which their trunks move."""

    def __init__(self, files: Sequence[RecordingFile], tolerance: float = 0.5, blend_s: float = 0.5):
        """`tolerance`: largest RMS of the differences between two trunks, in units of tolerances; arms are blended over
        `blend_s`. Files without a motion have none to give."""
        self.tolerance, self.blend_s = tolerance, blend_s
        self._files, trunks = [], []
        for file in files:
            motion = file.part("motion")
            if motion is not None and len(motion) > 1:
                self._files.append((file, motion.skeleton.joint_names, motion.fps))
                trunks.append(_trunk(motion))
        self._trunks = torch.cat([*trunks, torch.zeros(0, len(_TOLERANCES))]).T.contiguous()
        self._owner = torch.repeat_interleave(torch.tensor([len(each) for each in trunks], dtype=torch.long))
        self._first = torch.tensor([0, *(len(each) for each in trunks)]).cumsum(0)

    def mixed(self, motion: Motion, file: RecordingFile, seed: int) -> Motion:
        """The motion with arms of other recordings than `file`, which it is of: a function of the seed."""
        random = torch.Generator().manual_seed(seed)
        segments = [*self._segments(motion, file, random)]
        joints = motion.skeleton.indices(*ARMS)
        own, half = motion.R_parent_joint[:, joints], max(1, round(0.5 * self.blend_s * motion.fps))
        arms = own.clone()
        for before, segment in zip([None, *segments], segments):
            arms[segment.start : segment.stop] = self._arms(own, joints, segment, segment.start, segment.stop)
            if before is None or (before.donor is None and segment.donor is None):
                continue
            start, stop = max(segment.start - half, before.start), min(segment.start + half, segment.stop)
            share = (torch.arange(start, stop) + 0.5 - start) / (stop - start)
            share = share.square() * (3 - 2 * share)
            sides = [self._arms(own, joints, each, start, stop) for each in (before, segment)]
            arms[start:stop] = blended(*sides, share)
        mixed = motion.R_parent_joint.clone()
        mixed[:, joints] = arms
        return replace(motion, R_parent_joint=mixed)

    def _segments(self, motion: Motion, file: RecordingFile, random: torch.Generator) -> Iterator[_Segment]:
        """A motion's segments, each with the donor that was drawn."""
        trunk, start = _trunk(motion), 0
        every = _every(motion.fps)
        names, fps = motion.skeleton.joint_names, motion.fps
        fit = [
            each.path != file.path and who == names and abs(rate / fps - 1) < 0.01 for each, who, rate in self._files
        ]
        usable = torch.tensor(fit, dtype=torch.bool)
        while start < len(trunk):
            low, high = _LENGTHS_S
            count = round(_RATE * (low + (high - low) * torch.rand((), generator=random).item()))
            stop = len(trunk) if len(trunk) - start - count < low * _RATE else start + count
            last = len(motion) if stop == len(trunk) else stop * every
            place = self._place(trunk[start:stop], usable, random)
            if place is None:
                yield _Segment(start * every, last, None)
            else:
                donor = int(self._owner[place])
                yield _Segment(start * every, last, donor, (place - int(self._first[donor])) * every)
            start = stop

    def _place(self, trunk: Float[Tensor, "frame value"], usable: Tensor, random: torch.Generator) -> int | None:
        """Where among all donors' frames a trunk moves alike; None where none does."""
        count = len(trunk)
        if len(self._owner) < count or not usable.any():
            return None
        # |a - b|² = |a|² - 2 a·b + |b|², for all places at once.
        power = torch.cat([torch.zeros(1).double(), self._trunks.double().square().sum(0).cumsum(0)])
        cross = torch.nn.functional.conv1d(self._trunks[None], trunk.T[None])[0, 0]
        difference = (power[count:] - power[:-count]).float() - 2 * cross + trunk.square().sum()
        rms = (difference.clamp_min(0) / trunk.numel()).sqrt()
        owner, last = self._owner[: len(rms)], self._owner[count - 1 :]
        rms = rms.where((owner == last) & usable[owner], torch.inf)
        best = torch.full((len(usable),), torch.inf).scatter_reduce(0, owner, rms, "amin")
        order = best.argsort()[:_CANDIDATES]
        order = order[best[order] <= self.tolerance]
        if not len(order):
            return None
        donor = order[torch.randint(len(order), (), generator=random)]
        return int(rms.where(owner == donor, torch.inf).argmin())

    def _arms(
        self, own: Float[Tensor, "time arm 3 3"], joints: list[int], segment: _Segment, start: int, stop: int
    ) -> Float[Tensor, "frame arm 3 3"]:
        """The arms of a segment's donor at frames of the motion, those around the segment among them."""
        if segment.donor is None:
            return own[start:stop]
        file = self._files[segment.donor][0]
        frames = segment.at - segment.start + torch.arange(start, stop)
        frames = frames.clamp(0, file.length("motion.timestamps") - 1)
        first = int(frames[0])
        return file.window("motion.R_parent_joint", first, int(frames[-1]) + 1)[:, joints][frames - first]


def blended(
    R_a: Float[Tensor, "frame arm 3 3"], R_b: Float[Tensor, "frame arm 3 3"], share: Float[Tensor, "frame"]
) -> Float[Tensor, "frame arm 3 3"]:
    """Rotations on the way from R_a to R_b; the way stays on its side where the two are half a turn apart."""
    turn = rotation.quat_wxyz_from_matrix(R_a.mT @ R_b)
    same = torch.where((turn[1:] * turn[:-1]).sum(-1) < 0, -1.0, 1.0)
    turn = turn * torch.cat([torch.ones_like(turn[:1, :, 0]), same]).cumprod(0)[..., None]
    # The shorter way in the middle of the blend, where both weigh alike.
    turn = turn * torch.where(turn[len(turn) // 2, :, :1] < 0, -1.0, 1.0)
    size = turn[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(size, turn[..., :1])
    return R_a @ rotation.exp(share[:, None, None] * angle * turn[..., 1:] / size.clamp_min(1e-9))


def _every(fps: float) -> int:
    """Every so-many-th frame is compared."""
    return max(1, round(fps / _RATE))


def _trunk(motion: Motion) -> Float[Tensor, "frame value"]:
    """How the chest leans, turns (in its own axes), is turned against the pelvis and moves (in its own axes), per tolerance."""
    skeleton, every = motion.skeleton, _every(motion.fps)
    R_parent_joint, t_world_root = motion.R_parent_joint[::every], motion.t_world_root[::every]
    chest = skeleton.parents[skeleton.index("left_collar")]
    R_world_chest = forward_kinematics(skeleton, R_parent_joint, t_world_root).R[:, chest]
    rate = motion.fps / every
    turn = rotation.log(R_world_chest[:-1].mT @ R_world_chest[1:]) * rate
    move = (R_world_chest[:-1].mT @ (t_world_root.diff(dim=0) * rate)[..., None])[..., 0]
    turn, move = (torch.cat([each, each[-1:]]) if len(each) else torch.zeros(1, 3) for each in (turn, move))
    bend = rotation.log(R_parent_joint[:, 0].mT @ R_world_chest)
    return torch.cat([R_world_chest[:, 2], turn, bend, move], -1) / torch.tensor(_TOLERANCES)
