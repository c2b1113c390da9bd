"""Streaming HPS: takes frames as they are recorded and returns final motion with a fixed latency.

A window of the newest seconds is re-solved as frames arrive; frames older than `lag_s` are final and constrain those
that follow. Memory is bounded by the window, however long the recording.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Localization
from wearcap.recording.timing import at_times, joined
from wearcap.runtime.session import Session
from wearcap.runtime.system import CaptureInput
from wearcap.runtime.wearer import Wearer
from wearcap.scene.scan import Scan
from wearcap.sensors import packets
from wearcap.sensors.initialization import Initialization, align_suit, estimate_head_camera, initialize, inliers
from wearcap.sensors.packets import (
    BEHIND_S,
    MAX_POSITION_M,
    MAX_TIME_S,
    OFF_THE_CLOCK,
    WRONG_TYPE,
    rotation_fault,
    values_fault,
)
from wearcap.sensors.samples import LocalizationSample, SuitPiece
from wearcap.systems.hps.energy import HpsData, HpsState
from wearcap.systems.hps.pipeline import HPS, mount

MAX_UNALIGNED_S = 600.0
"""Length (s) of suit motion that is kept until the first alignment."""
OVERTAKEN_S = 0.05
"""Time (s) for which single frames wait for others that they overtook on their way."""
MAX_PAUSE_S = 10.0
"""Longest gap (s) within a stretch. A piece after a longer one is kept aside until the next piece continues it; then a
new stretch begins."""
MISSED_M, SEEN_S = 0.05, 0.3
"""Distance (m) of the last final frame from the localised path that is made up for, and time (s) for which the camera
must be localised after it."""
_LOCALIZED = ("timestamps", "R_world_cam", "t_world_cam", "confidence")


@dataclass(frozen=True)
class StreamSettings:
    """Window and latency of a stream (s)."""

    start_s: float = 5.0
    """Localised time needed before the suit is aligned and the first motion is returned."""
    window_s: float = 20.0
    """Length of the window from which heading and camera mount are estimated."""
    lag_s: float = 1.0
    """Latency: age at which a frame is final."""
    advance_s: float = 0.5
    """New motion after which the window is solved again."""
    behind_s: float = 1.5
    """Length of final motion that a window is constrained to."""
    tie: float = 30.0
    """Weight of a final frame's position, relative to a localised frame's (1)."""
    recovery_s: float = 1.0
    """Time in which the path returns to the camera's when that is found again."""


def _suit_fault(suit: object, like: Motion | None) -> str | None:
    """Reason to refuse a piece of a suit's motion, None for a good one; it must match an earlier good piece `like`."""
    if not isinstance(suit, Motion) or not isinstance(suit.timestamps, Tensor) or suit.timestamps.ndim != 1:
        return WRONG_TYPE
    times, count, joints = suit.timestamps, len(suit.timestamps), len(suit.skeleton)
    contact = suit.contact_prob
    patches = contact.shape[-1:] if isinstance(contact, Tensor) else ()
    fault = (
        _times_fault(times, MAX_PAUSE_S)
        or rotation_fault(suit.R_parent_joint, (count, joints, 3, 3))
        or values_fault(suit.t_world_root, (count, 3), MAX_POSITION_M)
        or (None if contact is None else values_fault(contact, (count, *patches), 1.0))
    )
    if fault is None and like is not None:
        shapes = [None if part is None else part.shape[1:] for part in (contact, like.contact_prob)]
        if like.skeleton.joint_names != suit.skeleton.joint_names or shapes[0] != shapes[1]:
            return WRONG_TYPE
    return fault


def _localization_fault(seen: object, suit: Motion) -> str | None:
    """Reason to refuse a piece's camera poses, None for good ones; poses of confidence 0 are not checked."""
    if not isinstance(seen, Localization) or not isinstance(seen.timestamps, Tensor):
        return WRONG_TYPE
    count = seen.timestamps.numel()
    if fault := _times_fault(seen.timestamps, math.inf) or values_fault(seen.confidence, (count,), 1.0):
        return fault
    shapes = [getattr(part, "shape", None) for part in (seen.R_world_cam, seen.t_world_cam)]
    if shapes != [(count, 3, 3), (count, 3)]:
        return WRONG_TYPE
    found = seen.confidence > 0
    R, t = seen.R_world_cam[found], seen.t_world_cam[found]
    if seen.timestamps[-1] > suit.timestamps[-1] + MAX_PAUSE_S:
        return OFF_THE_CLOCK
    return rotation_fault(R, (len(R), 3, 3)) or values_fault(t, (len(R), 3), MAX_POSITION_M)


def _times_fault(times: Tensor, max_pause_s: float) -> str | None:
    if fault := values_fault(times, (times.numel(),), MAX_TIME_S):
        return fault
    steps = times.diff()
    return None if ((steps > 0) & (steps <= max_pause_s)).all() else OFF_THE_CLOCK


def _follows(first: Motion, then: Motion) -> bool:
    """Whether a piece continues another, without overlap or a long gap."""
    return 0 < (then.timestamps[0] - first.timestamps[-1]).item() <= MAX_PAUSE_S


class HpsStream:
    """Takes consecutive pieces of a recording by `push` and returns final pieces of motion.

    A piece that is invalid (`sensors.packets`), or that does not follow the one before, is counted in `refused`. When
    two consecutive pieces follow each other but not those before, the clock has jumped: a new stretch begins and is
    aligned again.
    """

    def __init__(self, hps: HPS, about: Recording, scan: Scan | None, settings: StreamSettings | None = None):
        """Start a stream. `about` provides the wearer's shape and the camera with its mount; its streams are not read.
        Raises WearcapError without a camera, or without a scan where the energy needs one."""
        if about.camera is None:
            raise WearcapError("no camera in this recording", where=about.name, expected="its mount on the head")
        hps.require_scan(scan, about.name)
        self.hps, self.about, self.scan = hps, about, scan
        self.settings = settings or StreamSettings()
        self.mount = Rigid(*mount(about))
        self.refused: Counter[str] = Counter()
        """Number of refused pieces, or localisations of pieces, by reason such as "suit: off the clock"."""
        self._alone: tuple[Motion, Localization | None] | None = None
        """The last piece, if it did not follow those before."""
        self._finished: list[Motion] = []
        """Motions that `take` finished and `poses` did not return yet."""
        self._collected: dict[float, Motion] = {}
        """Single frames of the suit by time, and below poses of the camera, that `push` did not get yet."""
        self._cameras: list[LocalizationSample] = []
        self._any_returned = False
        """Whether any motion was returned."""
        self._like: Motion | None = None
        """The first valid piece; later ones must have the same joints and contacts."""
        self._begin()

    @property
    def dropped(self) -> int:
        """Number of refused localisations."""
        return sum(count for reason, count in self.refused.items() if reason.startswith("localization"))

    def take(self, sample: Any) -> None:
        """Take in a `SuitPiece` with its localisation, if it has one; or, as live devices send them, pieces of single frames
        and `LocalizationSample`s, which are collected for `advance_s`. Anything else is refused."""
        match sample:
            case SuitPiece(suit=Motion() as suit) if sample.localization is not None or len(suit) > 1:
                self._push_collected()
                self._push_piece(*sample)
            case SuitPiece():
                if fault := _suit_fault(sample.suit, self._like):
                    self.refused[f"suit: {fault}"] += 1
                elif len(sample.suit):
                    self._collect(sample.suit)
            case LocalizationSample():
                if fault := packets.time_fault(sample.timestamp) or packets.pose_fault(sample.T_world_cam):
                    self.refused[f"localization: {fault}"] += 1
                else:
                    self._cameras.append(sample)
                    del self._cameras[: -packets.MAX_WAITING]
            case _:
                self.refused[f"sample: {WRONG_TYPE}"] += 1

    def _push_piece(self, suit: Motion, localization: Localization | None) -> None:
        if (motion := self.push(suit, localization)) is not None:
            self._finished.append(motion)

    def _collect(self, suit: Motion) -> None:
        """Keep frames until they span `advance_s`; the newest wait for others that they overtook."""
        time = suit.timestamps[0].item()
        pushed = -math.inf if self.suit is None else self.suit.timestamps[-1].item()
        if 0 <= pushed - time < BEHIND_S:
            self.refused["suit: late"] += 1
            return
        self._collected[time] = suit
        newest, oldest = max(self._collected), min(self._collected)
        if newest - oldest >= self.settings.advance_s + OVERTAKEN_S:
            self._push_collected(newest - OVERTAKEN_S)

    def _push_collected(self, until: float = math.inf) -> None:
        """Push collected frames up to a time (s), in order of time, with the camera poses up to the last of them."""
        times = sorted(time for time in self._collected if time <= until)
        suit = joined([self._collected.pop(time) for time in times])
        if suit is None:
            return
        last_s = suit.timestamps[-1].item()
        seen = {each.timestamp: each for each in self._cameras if each.timestamp <= last_s}
        self._cameras = [each for each in self._cameras if each.timestamp > last_s]
        ordered = [seen[time] for time in sorted(seen)]
        localization = None
        if ordered:
            localization = Localization(
                torch.tensor([each.timestamp for each in ordered], dtype=torch.float64),
                torch.stack([each.T_world_cam.R for each in ordered]),
                torch.stack([each.T_world_cam.t for each in ordered]),
                torch.tensor([each.confidence for each in ordered]),
            )
        self._push_piece(suit, localization)

    def poses(self, ended: bool = False) -> Motion | None:
        """Frames that became final since the last call, or None; `ended`: no more pieces come. Raises as `finish`."""
        if ended:
            self._push_collected()
        if ended and not self._finished:
            return self.finish()
        return self._finished.pop(0) if self._finished else None

    def _begin(self) -> None:
        """Begin a new stretch."""
        self.suit: Motion | None = None
        """Suit motion that later windows still need, at its own rate."""
        self.seen: Localization | None = None
        self.turn: tuple[Float[Tensor, ""], Float[Tensor, "3"]] | None = None
        """Angle (rad) and translation (m) of the alignment, once it has been estimated."""
        self.R_head_cam = self.mount.R.double()
        self.yaw = torch.zeros((), dtype=torch.float64)
        self.done: Motion | None = None
        """The last final frames."""
        self._solved_to = -torch.inf

    def push(self, suit: Motion, localization: Localization | None = None) -> Motion | None:
        """Add new suit motion and localisation; returns the frames that have become final, if any. When a new stretch
        begins, the remaining frames of the previous one are returned."""
        fault = _suit_fault(suit, self._like)
        if fault is not None:
            self.refused[f"suit: {fault}"] += 1
            return None
        if not len(suit):
            return None
        self._like = self._like or suit
        if localization is not None:
            if fault := _localization_fault(localization, suit):
                self.refused[f"localization: {fault}"] += 1
                localization = None
            elif not len(localization.timestamps):
                localization = None
        if self.suit is None or _follows(self.suit, suit):
            self._refuse_alone()
            self._add(suit, localization)
            newest = suit.timestamps[-1].item()
            if self.turn is None and not self._align():
                self._forget(newest - MAX_UNALIGNED_S)
                return None
            if newest - self._solved_to < self.settings.advance_s:
                return None
            return self._advance(newest - self.settings.lag_s)
        if self._alone is None or not _follows(self._alone[0], suit):
            self._refuse_alone()
            self._alone = suit, localization
            return None
        (first, seen), self._alone = self._alone, None
        left = self._end()
        self._begin()
        self._add(first, seen)
        self._add(suit, localization)
        return left

    def _refuse_alone(self) -> None:
        if self._alone is not None:
            self.refused[f"suit: {OFF_THE_CLOCK}"] += 1
            self._alone = None

    def _add(self, suit: Motion, localization: Localization | None) -> None:
        self.suit = joined([suit] if self.suit is None else [self.suit, suit])
        if localization is None:
            return
        if self.seen is None:
            self.seen = localization
        elif localization.timestamps[0] <= self.seen.timestamps[-1]:
            self.refused[f"localization: {OFF_THE_CLOCK}"] += 1
        else:
            both = self.seen, localization
            self.seen = Localization(*(torch.cat([getattr(part, name) for part in both]) for name in _LOCALIZED))

    def finish(self) -> Motion | None:
        """Return the remaining frames at the end of the recording. Raises WearcapError when every piece was refused,
        and when no piece was ever localised."""
        self._refuse_alone()
        if self.suit is None and self.refused:
            what = f"no piece can be used ({', '.join(self.refused)})"
            raise WearcapError(what, where=self.about.name, expected="finite poses of the suit at rising times")
        motion = self._end()
        if self.suit is not None and not self._any_returned:
            what = "the camera was never localised"
            raise WearcapError(what, expected="some localised frames", where=self.about.name)
        return motion

    def _end(self) -> Motion | None:
        """Return the remaining frames of a stretch; None, and counted in `refused`, if it was never localised."""
        if self.suit is None:
            return None
        if self.turn is None and not self._align(enough=False):
            self.refused["stretch: never localised"] += 1
            return None
        return self._advance(self.suit.timestamps[-1].item() + 1.0)

    def _align(self, enough: bool = True) -> bool:
        """Align the suit once `start_s` seconds are localised; returns whether it is aligned."""
        assert self.suit is not None
        if self.seen is None:
            return False
        good = inliers(self.seen) & (self.seen.timestamps <= self.suit.timestamps[-1])
        step = self.seen.timestamps.diff().median().item() if len(good) > 1 else 0.0
        count = int(good.sum())
        if not count or (enough and count * step < self.settings.start_s):
            return False
        aligned, angle = align_suit(self.suit, self.seen, self.mount)
        turned = self.suit.t_world_root @ rotation.about_axis("z", angle).mT
        self.turn = angle, (aligned.t_world_root - turned)[0]
        return True

    def _advance(self, final_s: float) -> Motion | None:
        """Solve the newest window and return its frames up to `final_s`."""
        assert self.suit is not None
        fps, settings = self.hps.fps, self.settings
        aligned = self._window()
        self._solved_to = self.suit.timestamps[-1].item()
        start = self._start(aligned)
        after = self.done.timestamps[-1].item() if self.done is not None else -torch.inf
        times = aligned.timestamps
        first = int(torch.searchsorted(times, after - settings.behind_s)) if self.done is not None else 0
        recording = replace(self.about, suit=self.suit, localization=self.seen)
        data = self.hps.problem(recording, aligned, start, self.scan, self.R_head_cam)[first:]
        count = int((times[first:] <= after + 0.5 / fps).sum())
        if self.done is not None and count:
            data = self._tied(data, self.done.sliced(len(self.done) - count, len(self.done)))
        solution = self.hps.optimize(data)
        part = replace(start, motion=start.motion.sliced(first, len(times)))
        motion = self.hps.motion(part, solution)
        new = (motion.timestamps > after + 0.5 / fps) & (motion.timestamps <= final_s)
        if not new.any():
            return None
        self._any_returned = True
        begin, stop = int(new.nonzero()[0]), int(new.nonzero()[-1]) + 1
        keep = int((settings.behind_s + 1.0) * fps)
        self.done = motion.sliced(max(0, stop - keep), stop)
        self._forget(motion.timestamps[stop - 1].item() - settings.window_s)
        return motion.sliced(begin, stop)

    def _tied(self, data: HpsData, final: Motion) -> HpsData:
        """The window's data after frames that are final: their positions replace the camera's in the `hold` term.

        Where they had drifted, and the camera is localised again, the way from the last of them to the localised path
        is covered within `recovery_s`, in addition to the suit's displacements.
        """
        fps, count = self.hps.fps, len(final)
        t, hold, t_step = data.start.t_world_root.clone(), data.hold_confidence.clone(), data.steps.t_step.clone()
        missed = t[count - 1] - final.t_world_root[-1].double()
        if missed.norm() > MISSED_M and hold[count:].count_nonzero() >= SEEN_S * fps:
            share = (torch.arange(len(t) - count + 1) / (fps * self.settings.recovery_s)).clamp(max=1.0).to(t)
            t[count:] -= (1 - share[1:, None]) * missed
            t_step[count - 1 :] += share.diff()[:, None] * missed
        t[:count], hold[:count] = final.t_world_root.double(), self.settings.tie
        tied = HpsState(data.start.theta, data.start.R_world_root, t)
        return replace(data, start=tied, hold_confidence=hold, steps=replace(data.steps, t_step=t_step))

    def _window(self) -> Motion:
        """Aligned suit motion of the window at the pipeline's rate."""
        assert self.suit is not None
        assert self.turn is not None
        fps, (angle, move) = self.hps.fps, self.turn
        first, last = (round(self.suit.timestamps[end].item() * fps) for end in (0, -1))
        times = torch.arange(first, last + 1, dtype=torch.float64) / fps
        inside = (times >= self.suit.timestamps[0]) & (times <= self.suit.timestamps[-1])
        motion, turn = at_times(self.suit, times[inside]), rotation.about_axis("z", angle)
        return motion.moved(Rigid(turn, move))

    def _start(self, aligned: Motion) -> Initialization:
        """The window's initialisation; without localised frames the suit's motion goes on from the last final one."""
        seen = self.seen
        first, last = aligned.timestamps[0], aligned.timestamps[-1]
        if seen is not None and (good := inliers(seen) & (seen.timestamps >= first) & (seen.timestamps <= last)).any():
            start = initialize(aligned, seen, self.mount.R, self.mount.t, self.hps.initialization)
            self.yaw = start.yaw_correction[-1].double()
            sure = torch.where(good, seen.confidence, 0.0)
            nearest = torch.searchsorted(aligned.timestamps, seen.timestamps).clamp(max=len(aligned) - 1)
            self.R_head_cam = estimate_head_camera(
                start.motion.joint("head").R[nearest].double(), seen.R_world_cam.double(), sure.double()
            )
            return start
        carried = aligned.moved(Rigid(rotation.about_axis("z", self.yaw.float()), torch.zeros(3)))
        if self.done is not None:
            at = int(torch.searchsorted(carried.timestamps, self.done.timestamps[-1]).clamp(max=len(carried) - 1))
            move = self.done.t_world_root[-1] - carried.t_world_root[at]
            carried = replace(carried, t_world_root=carried.t_world_root + move)
        lost = torch.zeros(len(aligned), dtype=torch.bool)
        return Initialization(carried, lost, self.yaw.expand(len(aligned)), carried.t_world_root.diff(dim=0))

    def _forget(self, before_s: float) -> None:
        """Drop frames that no later window needs."""
        assert self.suit is not None
        first = int(torch.searchsorted(self.suit.timestamps, before_s))
        self.suit = self.suit.sliced(first, len(self.suit))
        if self.seen is not None:  # two are kept: they determine the frame rate
            first = int(torch.searchsorted(self.seen.timestamps, before_s))
            kept = slice(max(min(first, len(self.seen.timestamps) - 2), 0), None)
            self.seen = Localization(*(getattr(self.seen, name)[kept] for name in _LOCALIZED))


class HpsSession(Session):
    """A streaming capture of one or several wearers in one scene, each by an `HpsStream`."""

    devices = ("suit", "camera")

    def __init__(self, hps: HPS, wearers: Sequence[Recording], scan: Scan | None):
        """`wearers`: each one's shape and camera (`HpsStream`). Raises WearcapError as `HpsStream` does."""
        super().__init__(hps, [HpsStream(hps, about, scan) for about in wearers])

    @classmethod
    def of_wearers(
        cls, system: HPS, wearers: Sequence[Wearer], seed: int = 0, source: CaptureInput | None = None
    ) -> "HpsSession":
        """Each wearer's camera and its mount are those of the source's recording. Raises WearcapError without one."""
        if source is None:
            what = "a live suit without its head camera's description"
            raise WearcapError(what, expected="recording=FILE with the camera and its mount, and the scene's scan")
        return cls(system, [source.recording] * len(wearers), source.read_scan())

    @classmethod
    def of_piece(cls, system: HPS, piece: Recording, folder: Path, refused: Counter[str] | None) -> SuitPiece | None:
        """A piece's camera is localised if it has images and no poses; file names in it are relative to `folder`.

        Camera and suit must share a clock, as claps would be detected too late; raises WearcapError otherwise.
        """
        if system.synchronization.by_claps(piece):
            fix = "Set the clocks before, and give pipeline.synchronization.clock=shared."
            raise WearcapError("a live recording cannot be synchronised by claps", where=piece.name, fix=fix)
        if piece.suit is None:
            if refused is None:
                raise WearcapError("no suit in this piece", where=piece.name, expected="a suit's motion in each piece")
            refused[f"suit: {WRONG_TYPE}"] += 1
            return None
        localization = piece.localization
        if piece.camera is not None:
            try:
                localization = system.localization(piece, folder)
            except WearcapError:
                if refused is None:
                    raise
                refused["localization: failed"] += 1
                localization = None
        return SuitPiece(piece.suit, localization)


SESSION = HpsSession
