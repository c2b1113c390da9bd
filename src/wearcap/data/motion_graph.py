"""Walks through a motion graph: recorded motions go over into each other where poses and their movement fit.

After Kovar, Gleicher and Pighin, "Motion Graphs" (2002). Poses are compared over the length of a blend, as joints seen from
the body's own place and heading; a walk plays a clip for a while, leaves it where another agrees, and blends the two.
Blends in which a planted foot slides or a foot sinks into the ground are not used.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from wearcap.body.kinematics import forward_kinematics, site_positions
from wearcap.body.skeleton import FOOT_PATCHES, Skeleton
from wearcap.data.arm_mixing import blended
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.recording import Motion, Recording

_RATE = 10.0
"""Rate (Hz) at which clips are compared."""
_TARGETS = 8
"""Clips that a moment may lead to: those that agree best."""
_SHARED = ("left_knee", "left_ankle", "right_knee", "right_ankle")
"""Joints whose bones' lengths scale the path of somebody else."""


@dataclass(frozen=True)
class WalkSettings:
    """How clips go over into each other."""

    agreement_m: float = 0.08
    """Largest RMS distance of the joints of two clips over a blend (m)."""
    blend_s: float = 0.4
    shortest_s: float = 0.6
    """Shortest time of a clip between two blends."""
    longest_s: float = 6.0
    """Time after which a clip is left at the next occasion."""
    slide_m_s: float = 0.4
    """Largest mean speed in a blend of a foot that both clips have on the ground."""
    sink_m: float = 0.03
    """Largest depth of a foot below the ground in a blend."""


@dataclass(frozen=True)
class Part:
    """Frames of a clip, by its number in `MotionGraph.recordings`."""

    clip: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class _Clip:
    """A recording's motion, and which of its feet are on the ground."""

    recording: Recording
    motion: Motion
    contact: Bool[Tensor, "time patch"]


class MotionGraph:
    """Clips at one rate and in one skeleton's joints, and where they go over into each other."""

    def __init__(self, recordings: Sequence[Recording], settings: WalkSettings | None = None):
        """Recordings with true motion and contacts, on level floors at z = 0.

        Raises WearcapError without two clips that are long enough, and for clips of several rates or skeletons.
        """
        self.settings = settings or WalkSettings()
        clips = [_clip(each) for each in recordings]
        self.fps = clips[0].motion.fps if clips else _RATE
        for each in clips:
            names, other = each.motion.skeleton.joint_names, clips[0].motion.skeleton.joint_names
            if names != other or abs(each.motion.fps / self.fps - 1) > 0.01:
                what = f"{each.recording.name} has {each.motion.fps:g} frames per second, or other joints"
                raise WearcapError(what, expected=f"clips prepared alike, at {self.fps:g}")
        self._every = max(1, round(self.fps / _RATE))
        self._blend = max(2, round(self.settings.blend_s * self.fps))
        self._stay = max(self._blend, round(self.settings.shortest_s * self.fps))
        self._in_frames = torch.tensor([self._every, 1, self._every])
        """Frames of a transition's moments."""
        self._steps = -(-self._blend // self._every)
        long_enough = max(self._steps * self._every, self.settings.shortest_s * self.fps)
        self._clips = [each for each in clips if len(each.motion) > long_enough]
        if len(self._clips) < 2:
            expected = f"clips of more than {long_enough / self.fps:g} s"
            raise WearcapError("a motion graph without two clips", expected=expected)
        self._edges = self._compared()
        """Of each clip, rows of its moment (every so many frames), the other clip and its moment."""
        self._endless = self._leading_further()
        """Whether each of these leads to where a walk can go on for ever."""

    def _compared(self) -> list[Int64[Tensor, "edge 3"]]:
        """Where each clip may go over into others: at the moments that agree best, unless feet forbid it."""
        person = self._clips[0].motion.skeleton
        motions = [_scaled(each.motion, person) for each in self._clips]
        seen = [_seen_from_itself(each, self._every, self._steps) for each in motions]
        # Enough of a clip must be left to be played before it is left again.
        least = round(self.settings.shortest_s * _RATE)
        usable = torch.cat([torch.arange(len(each), 0, -1) >= least for each in seen])
        lengths, everything, edges = [len(each) for each in seen], torch.cat(seen), []
        for number, blends in enumerate(seen):
            found = self._leading_on(number, blends, everything, usable, lengths)
            holds = [self._feet_hold(motions, number, part) for part in found.split(256)]
            edges.append(found[torch.cat(holds)] if holds else found)
        return edges

    def _leading_on(
        self, number: int, blends: Tensor, everything: Tensor, usable: Tensor, lengths: list[int]
    ) -> Tensor:
        """Moments of a clip, of others, and their moments, where the two agree: the best moment of the best clips."""
        rows, most = [], self.settings.agreement_m * (blends.shape[1] / 3) ** 0.5
        for start in range(0, len(blends), 512):
            distance = torch.cdist(blends[start : start + 512], everything).masked_fill_(~usable, torch.inf)
            found = [part.min(1) for part in distance.split(lengths, 1)]
            least, place = (
                torch.stack([each.values for each in found], 1),
                torch.stack([each.indices for each in found], 1),
            )
            least[:, number] = torch.inf
            best = least.topk(min(_TARGETS, len(lengths)), largest=False)
            moment, rank = (best.values <= most).nonzero().unbind(1)
            clip = best.indices[moment, rank]
            rows.append(torch.stack([start + moment, clip, place[moment, clip]], 1))
        return torch.cat(rows)

    def _leading_further(self) -> list[Bool[Tensor, "edge"]]:
        """Which transitions remain when those that lead to no further ones are taken away again and again."""
        stay = -(-self._stay // self._every)
        endless = [torch.ones(len(each), dtype=torch.bool) for each in self._edges]
        while True:
            exits = [edges[further, 0] for edges, further in zip(self._edges, endless)]
            last = torch.tensor([int(each.max()) if len(each) else -1 for each in exits])
            fewer = [
                further & (edges[:, 2] + stay <= last[edges[:, 1]]) for edges, further in zip(self._edges, endless)
            ]
            if all(map(torch.equal, fewer, endless)):
                return endless
            endless = fewer

    @property
    def recordings(self) -> list[Recording]:
        """The recordings that are long enough to be joined."""
        return [each.recording for each in self._clips]

    @property
    def transitions(self) -> int:
        """Number of transitions of all moments."""
        return sum(map(len, self._edges))

    def walk(self, seconds: float, seed: int) -> tuple[Motion, list[Part]]:
        """A motion of at most so many seconds, and the clips' frames that it consists of: a function of the seed.

        The first clip's person does all of it; clips that were not used yet are preferred, and those that lead nowhere
        avoided. A walk that meets one ends with it.
        """
        random = torch.Generator().manual_seed(seed)
        parts, uses = [], Counter[int]()
        played = self._stay / self._every
        lasting = [
            number
            for number, (edges, endless) in enumerate(zip(self._edges, self._endless))
            if (endless & (edges[:, 0] >= played)).any()
        ]
        starts = lasting or list(range(len(self._clips)))
        clip = starts[int(torch.randint(len(starts), (), generator=random))]
        at, frames = 0, round(seconds * self.fps)
        while True:
            uses[clip] += 1
            end = min(len(self._clips[clip].motion), at + frames)
            edge = self._exit(clip, at, end, uses, random)
            if edge is None:
                parts.append(Part(clip, at, end))
                return self._played(parts), parts
            leave, following, arrive = edge
            parts.append(Part(clip, at, leave + self._blend))
            frames -= leave - at
            clip, at = following, arrive

    def _exit(
        self, clip: int, at: int, end: int, uses: Counter[int], random: torch.Generator
    ) -> tuple[int, int, int] | None:
        """Frame at which a clip is left, the clip that follows, and its frame."""
        edges, endless = self._edges[clip] * self._in_frames, self._endless[clip]
        fits = (edges[:, 0] >= at + self._stay) & (edges[:, 0] + self._blend <= end)
        if not fits.any():
            return None
        edges = edges[fits & endless if (fits & endless).any() else fits]
        # Clips that were used seldom, and those that are met in the usual time.
        used = torch.tensor([uses[each] for each in edges[:, 1].tolist()])
        late = (edges[:, 0] - at - self.settings.longest_s * self.fps).clamp_min(0) / self.fps
        weight = 0.25 ** (used - used.min()) * (1 + late - late.min()) ** -6
        leave, following, arrive = edges[int(torch.multinomial(weight, 1, generator=random))].tolist()
        return leave, following, arrive

    def _feet_hold(self, motions: list[Motion], number: int, edges: Int64[Tensor, "edge 3"]) -> Bool[Tensor, "edge"]:
        """Whether feet that both clips have on the ground stay there in blends of a clip with others, and none sinks."""
        if not len(edges):
            return torch.zeros(0, dtype=torch.bool)
        n, frames = self._blend, (edges * self._in_frames).tolist()
        sides, down = [], []
        for places in ([(number, leave) for leave, _, _ in frames], [(other, arrive) for _, other, arrive in frames]):
            cuts = [motions[clip].sliced(start, start + n) for clip, start in places]
            sides.append(
                [torch.stack([getattr(each, key) for each in cuts], 1) for key in ("R_parent_joint", "t_world_root")]
            )
            down.append(torch.stack([self._clips[clip].contact[start : start + n] for clip, start in places], 1))
        skeleton = motions[0].skeleton
        R, t = _crossed(*sides[0], *_met(*sides[1], *sides[0]))
        feet = site_positions(skeleton, forward_kinematics(skeleton, R, t), FOOT_PATCHES)
        held = down[0] & down[1]
        held = held[1:] & held[:-1]
        speed = feet.diff(dim=0).norm(dim=-1) * self.fps
        slide = (speed * held).sum(0) / held.sum(0).clamp_min(1)
        return (slide <= self.settings.slide_m_s).all(-1) & (feet[..., 2].amin((0, 2)) >= -self.settings.sink_m)

    def _played(self, parts: Sequence[Part]) -> Motion:
        """The parts one after the other, each beginning where the one before ends, blended over the frames they share."""
        skeleton, n = self._clips[parts[0].clip].motion.skeleton, self._blend
        rotations, places = [], []
        for part in parts:
            motion = _scaled(self._clips[part.clip].motion.sliced(part.start, part.stop), skeleton)
            R, t = motion.R_parent_joint, motion.t_world_root
            if rotations:
                before = rotations[-1][-n:], places[-1][-n:]
                R, t = _met(R, t, *before)
                rotations[-1], places[-1] = rotations[-1][:-n], places[-1][:-n]
                crossing = _crossed(*before, R[:n], t[:n])
                R, t = torch.cat([crossing[0], R[n:]]), torch.cat([crossing[1], t[n:]])
            rotations.append(R)
            places.append(t)
        t = torch.cat(places)
        times = torch.arange(len(t), dtype=torch.float64) / self.fps
        return Motion(times, skeleton, torch.cat(rotations).contiguous(), t.contiguous())


def _met(
    R: Float[Tensor, "time *batch joint 3 3"],
    t: Float[Tensor, "time *batch 3"],
    R_before: Float[Tensor, "blend *batch joint 3 3"],
    t_before: Float[Tensor, "blend *batch 3"],
) -> tuple[Tensor, Tensor]:
    """A motion turned about the vertical and moved over the ground, to be where another is in the middle of a blend."""
    middle = len(t_before) // 2
    ahead = rotation.yaw_of(R_before[middle, ..., 0, :, :]) - rotation.yaw_of(R[middle, ..., 0, :, :])
    turn = rotation.about_axis("z", ahead)
    R = torch.cat([(turn @ R[..., 0, :, :]).unsqueeze(-3), R[..., 1:, :, :]], -3)
    t = (turn @ t[..., None])[..., 0]
    return R, t + (t_before[middle] - t[middle]) * torch.tensor([1.0, 1.0, 0.0])


def _crossed(
    R_a: Float[Tensor, "blend *batch joint 3 3"],
    t_a: Float[Tensor, "blend *batch 3"],
    R_b: Float[Tensor, "blend *batch joint 3 3"],
    t_b: Float[Tensor, "blend *batch 3"],
) -> tuple[Tensor, Tensor]:
    """The frames of one motion going over into those of another, softly at both ends."""
    share = (torch.arange(len(t_a)) + 0.5) / len(t_a)
    share = share.square() * (3 - 2 * share)
    R = blended(R_a.flatten(1, -3), R_b.flatten(1, -3), share).view_as(R_a)
    return R, torch.lerp(t_a, t_b, share.view(-1, *[1] * (t_a.dim() - 1)))


def _clip(recording: Recording) -> _Clip:
    motion, feet = recording.motion, recording.contacts and recording.contacts.feet
    if motion is None or feet is None or len(feet) != len(motion) or recording.floor is None:
        what = f"{recording.name} has no motion with contacts on a level floor"
        raise WearcapError(what, expected="motion capture from wearcap prepare")
    return _Clip(recording, motion, feet)


def _scaled(motion: Motion, skeleton: Skeleton) -> Motion:
    """The motion done by somebody else: rotations as they are, the path as long as the legs, so that feet stay planted."""
    ours, theirs = (
        sum(each.t_parent_joint[each.index(name)].norm() for name in _SHARED) for each in (motion.skeleton, skeleton)
    )
    return replace(motion, skeleton=skeleton, t_world_root=theirs / ours * motion.t_world_root)


def _seen_from_itself(motion: Motion, every: int, count: int) -> Float[Tensor, "moment value"]:
    """Joints over `count` steps from each moment, as seen from the place and heading of the pelvis in their middle."""
    R, t = motion.R_parent_joint[::every], motion.t_world_root[::every]
    joints = forward_kinematics(motion.skeleton, R, t).t
    spans = joints.unfold(0, count + 1, 1).movedim(-1, 1)
    middle = slice(count // 2, count // 2 + len(spans))
    heading = rotation.about_axis("z", rotation.yaw_of(R[middle, 0]))
    origin = t[middle] * torch.tensor([1.0, 1.0, 0.0])
    return ((spans - origin[:, None, None]) @ heading[:, None]).flatten(1)
