"""HPS while it is being recorded: frames go in as they come, finished motion comes out some time later.

A window of the newest seconds is solved again and again; frames older than `lag_s` are final and hold those that
follow. Memory is that of a window, however long the recording.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.optimize.hps import HpsData, HpsState
from wearcap.recording import Motion, Recording
from wearcap.recording.recording import Localization
from wearcap.recording.timing import at_times, joined
from wearcap.scene.scan import Scan
from wearcap.sensors.alignment import align_suit, estimate_head_camera, inliers
from wearcap.sensors.initialization import Initialization, initialize
from wearcap.sensors.packets import OFF_THE_CLOCK, WRONG_TYPE
from wearcap.systems.hps.pieces import cut, follows, localization_fault, more, suit_fault
from wearcap.systems.hps.pipeline import HPS

MAX_UNALIGNED_S = 600.0
"""While nothing is localised, the newest so many seconds of the suit are kept."""


@dataclass(frozen=True)
class StreamSettings:
    """Lengths in seconds."""

    start_s: float = 5.0
    """Of localised frames before the suit is aligned and the first motion comes."""
    window_s: float = 20.0
    """What heading and camera's mount are drawn from."""
    lag_s: float = 1.0
    """Age at which a frame is final."""
    advance_s: float = 0.5
    """A window is solved each time so much is new."""
    behind_s: float = 1.5
    """Of final frames that a window is tied to."""
    tie: float = 30.0
    """Weight of a final frame's position among localised ones (1)."""


class HpsStream:
    """Feed `push` with pieces of a recording, in order; finished pieces of motion are returned.

    A piece that cannot be true (`sensors.packets`), or that does not follow the one before, is `refused`. Where two
    pieces in a row follow each other and not those before, the clock has moved: a new stretch begins, aligned anew.
    """

    def __init__(self, hps: HPS, about: Recording, scan: Scan | None, settings: StreamSettings | None = None):
        """`about` gives the wearer's shape and the camera with its mount; its streams are not read.

        Raises WearcapError without a camera, or a scan where the energy asks for one.
        """
        if about.camera is None:
            raise WearcapError(
                "no camera in this recording", where=about.name, expected="its mount on the head"
            )
        hps.require_scan(scan, about.name)
        self.hps, self.about, self.scan = hps, about, scan
        self.settings = settings or StreamSettings()
        self.mount = Rigid(about.camera.R_head_cam, about.camera.t_head_cam)
        self.refused: Counter[str] = Counter()
        """Pieces, or their localisation, that were refused, by reason: "suit: off the clock"."""
        self._alone: tuple[Motion, Localization | None] | None = None
        """The last piece, where it did not follow those before."""
        self._given = False
        """Whether any motion was handed out."""
        self._like: Motion | None = None
        """The first good piece: those to come have its joints and contacts."""
        self._begin()

    def _begin(self) -> None:
        """Begin a stretch."""
        self.suit: Motion | None = None
        """What was pushed and is still needed, at the pipeline's rate."""
        self.seen: Localization | None = None
        self.turn: tuple[Float[Tensor, ""], Float[Tensor, "3"]] | None = None
        """Angle and translation of the alignment, once it is known."""
        self.R_head_cam = self.mount.R.double()
        self.yaw = torch.zeros((), dtype=torch.float64)
        self.done: Motion | None = None
        """The last final frames."""
        self._solved_to = -torch.inf

    def push(self, suit: Motion, localization: Localization | None = None) -> Motion | None:
        """Take in what is new of suit and localisation; returns the frames that have become final, if any.

        Where a new stretch begins these are the last ones of the stretch before.
        """
        fault = suit_fault(suit, self._like)
        if fault is not None:
            self.refused[f"suit: {fault}"] += 1
            return None
        if not len(suit):
            return None
        self._like = self._like or suit
        localization = self._checked(localization, suit)
        if self.suit is None or follows(self.suit, suit):
            self._refuse_alone()
            self._add(suit, localization)
            return self._solve()
        if self._alone is None or not follows(self._alone[0], suit):
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

    def _checked(self, localization: object, suit: Motion) -> Localization | None:
        """The localisation of a piece, or None where it cannot be used."""
        if localization is None:
            return None
        if fault := localization_fault(localization, suit):
            self.refused[f"localization: {fault}"] += 1
            return None
        assert isinstance(localization, Localization)
        return localization if len(localization.timestamps) else None

    def _add(self, suit: Motion, localization: Localization | None) -> None:
        self.suit = joined([suit] if self.suit is None else [self.suit, suit])
        if (
            localization is not None
            and self.seen is not None
            and localization.timestamps[0] <= self.seen.timestamps[-1]
        ):
            self.refused[f"localization: {OFF_THE_CLOCK}"] += 1
        elif localization is not None:
            self.seen = localization if self.seen is None else more(self.seen, localization)

    def _solve(self) -> Motion | None:
        """The frames that have become final."""
        assert self.suit is not None
        newest = self.suit.timestamps[-1].item()
        if self.turn is None and not self._align():
            self._forget(newest - MAX_UNALIGNED_S)
            return None
        if newest - self._solved_to < self.settings.advance_s:
            return None
        return self._advance(newest - self.settings.lag_s)

    def finish(self) -> Motion | None:
        """The frames that are left when the recording has ended.

        Raises WearcapError when every piece was refused, and when none was ever localised.
        """
        self._refuse_alone()
        if self.suit is None and self.refused:
            raise WearcapError(
                f"no piece can be used ({', '.join(self.refused)})", where=self.about.name,
                expected="finite poses of the suit at rising times",
            )  # fmt: skip
        motion = self._end()
        if self.suit is not None and not self._given:
            raise WearcapError(
                "the camera was never localised", expected="some localised frames", where=self.about.name
            )
        return motion

    def _end(self) -> Motion | None:
        """The frames that are left of a stretch; none where it was never localised, which is counted."""
        if self.suit is None:
            return None
        if self.turn is None and not self._align(enough=False):
            self.refused["stretch: never localised"] += 1
            return None
        return self._advance(self.suit.timestamps[-1].item() + 1.0)

    def _align(self, enough: bool = True) -> bool:
        """Align once `start_s` seconds are localised; whether that was possible."""
        assert self.suit is not None
        if self.seen is None:
            return False
        good = inliers(self.seen) & (self.seen.timestamps <= self.suit.timestamps[-1])
        count = int(good.sum())
        if not count or (enough and count * _step(self.seen.timestamps) < self.settings.start_s):
            return False
        aligned, angle = align_suit(self.suit, self.seen, self.mount)
        turned = self.suit.t_world_root @ rotation.about_axis("z", angle).mT
        self.turn = angle, (aligned.t_world_root - turned)[0]
        return True

    def _advance(self, final_s: float) -> Motion | None:
        """Solve the newest window and hand out its frames up to `final_s`."""
        assert self.suit is not None
        fps, settings = self.hps.fps, self.settings
        aligned = self._window()
        self._solved_to = self.suit.timestamps[-1].item()
        start = self._start(aligned)
        after = self.done.timestamps[-1].item() if self.done is not None else -torch.inf
        times = aligned.timestamps
        first = int(torch.searchsorted(times, after - settings.behind_s)) if self.done is not None else 0
        data = self.hps.problem(self._recording(), aligned, start, self.scan, self.R_head_cam)[first:]
        solution = self.hps.optimize(self._tied(data, times[first:]))
        part = replace(start, motion=start.motion.sliced(first, len(times)))
        motion = self.hps.motion(part, solution)
        new = (motion.timestamps > after + 0.5 / fps) & (motion.timestamps <= final_s)
        if not new.any():
            return None
        self._given = True
        begin, stop = int(new.nonzero()[0]), int(new.nonzero()[-1]) + 1
        keep = int((settings.behind_s + 1.0) * fps)
        self.done = motion.sliced(max(0, stop - keep), stop)
        self._forget(motion.timestamps[stop - 1].item() - settings.window_s)
        return motion.sliced(begin, stop)

    def _window(self) -> Motion:
        """The suit's frames at the pipeline's rate, aligned."""
        assert self.suit is not None
        assert self.turn is not None
        fps, (angle, move) = self.hps.fps, self.turn
        first, last = (round(self.suit.timestamps[end].item() * fps) for end in (0, -1))
        times = torch.arange(first, last + 1, dtype=torch.float64) / fps
        inside = (times >= self.suit.timestamps[0]) & (times <= self.suit.timestamps[-1])
        motion, turn = at_times(self.suit, times[inside]), rotation.about_axis("z", angle)
        return motion.moved(Rigid(turn, move))

    def _start(self, aligned: Motion) -> Initialization:
        """The window's initialisation; while nothing of it is localised, the suit carries on from the last frames."""
        seen = self.seen
        if seen is not None and (_inside(seen, aligned) & inliers(seen)).any():
            start = initialize(aligned, seen, self.mount.R, self.mount.t, self.hps.initialization)
            self.yaw = start.yaw_correction[-1].double()
            sure = torch.where(inliers(seen) & _inside(seen, aligned), seen.confidence, 0.0)
            nearest = torch.searchsorted(aligned.timestamps, seen.timestamps).clamp(max=len(aligned) - 1)
            self.R_head_cam = estimate_head_camera(
                start.motion.joint("head").R[nearest].double(), seen.R_world_cam.double(), sure.double()
            )
            return start
        carried = aligned.moved(Rigid(rotation.about_axis("z", self.yaw.float()), torch.zeros(3)))
        if self.done is not None:
            at = int(
                torch.searchsorted(carried.timestamps, self.done.timestamps[-1]).clamp(max=len(carried) - 1)
            )
            move = self.done.t_world_root[-1] - carried.t_world_root[at]
            carried = replace(carried, t_world_root=carried.t_world_root + move)
        lost = torch.zeros(len(aligned), dtype=torch.bool)
        return Initialization(carried, lost, self.yaw.expand(len(aligned)))

    def _tied(self, data: HpsData, times: Float64[Tensor, "time"]) -> HpsData:
        """Final frames hold those that follow: their positions stand for the camera's."""
        if self.done is None:
            return data
        known = int((times <= self.done.timestamps[-1] + 0.5 / self.hps.fps).sum())
        final = self.done.sliced(len(self.done) - known, len(self.done))
        t, hold = data.start.t_world_root.clone(), data.hold_confidence.clone()
        t[:known], hold[:known] = final.t_world_root.double(), self.settings.tie
        return replace(
            data, start=HpsState(data.start.theta, data.start.R_world_root, t), hold_confidence=hold
        )

    def _recording(self) -> Recording:
        assert self.seen is not None
        return replace(self.about, suit=self.suit, localization=self.seen)

    def _forget(self, before_s: float) -> None:
        """Drop what no later window needs."""
        assert self.suit is not None
        first = int(torch.searchsorted(self.suit.timestamps, before_s))
        self.suit = self.suit.sliced(first, len(self.suit))
        if self.seen is not None:  # two stay, which tell the rate where nothing new comes
            first = int(torch.searchsorted(self.seen.timestamps, before_s))
            self.seen = cut(self.seen, max(min(first, len(self.seen.timestamps) - 2), 0))


def follow(
    hps: HPS,
    pieces: Iterable[Recording],
    scan: Scan | None,
    folder: Path = Path(),
    settings: StreamSettings | None = None,
    refused: Counter[str] | None = None,
) -> Iterator[Motion]:
    """Motion of a recording that is still being made, piece by piece; `folder` holds what pieces name.

    A piece's camera is localised where it brings pictures and no poses. Camera and suit must share a clock: claps
    are heard too late. `refused` counts what could not be used, by reason (`HpsStream.refused`).
    Raises WearcapError when the clocks are not shared, the first piece has no suit or cannot be localised, or the
    energy asks for a scan.
    """
    stream: HpsStream | None = None
    refused = Counter() if refused is None else refused
    for piece in pieces:
        if piece.suit is None and stream is None:
            raise WearcapError(
                "no suit in this piece", where=piece.name, expected="a suit's motion in each piece"
            )
        if hps.synchronization.by_claps(piece):
            raise WearcapError("claps cannot bring a growing recording's clocks together", where=piece.name,
                               fix="Set the clocks before, and give pipeline.synchronization.clock=shared.")  # fmt: skip
        if piece.suit is None:
            refused[f"suit: {WRONG_TYPE}"] += 1
            continue
        fresh = stream is None
        if stream is None:
            stream = HpsStream(hps, piece, scan, settings)
            stream.refused = refused
        done = stream.push(piece.suit, _localized(hps, piece, folder, None if fresh else refused))
        if done is not None:
            yield done
    last = stream.finish() if stream is not None else None
    if last is not None:
        yield last


def _localized(hps: HPS, piece: Recording, folder: Path, refused: Counter[str] | None) -> Localization | None:
    """Where the camera was; what cannot be localised is counted, but without a counter raised."""
    if piece.camera is None:
        return piece.localization
    try:
        return hps.localize(piece, folder)
    except WearcapError:
        if refused is None:
            raise
        refused["localization: failed"] += 1
        return None


def _step(timestamps: Float64[Tensor, "time"]) -> float:
    return timestamps.diff().median().item() if len(timestamps) > 1 else 0.0


def _inside(seen: Localization, motion: Motion) -> Tensor:
    return (seen.timestamps >= motion.timestamps[0]) & (seen.timestamps <= motion.timestamps[-1])
