"""HPS on a growing recording: the frames of the whole, in order, from bounded memory."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hps_walk import floor_points, hps_recording
from hydra.utils import instantiate

from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.recording import Motion, Recording
from wearcap.recording.pieces import _piece_path, close_pieces, follow_pieces, write_piece
from wearcap.runtime.system import CaptureInput
from wearcap.scene.scan import Scan
from wearcap.systems.hps.pipeline import HPS
from wearcap.systems.hps.stream import HpsSession, HpsStream, StreamSettings

SETTINGS = StreamSettings(start_s=2.0, window_s=6.0)


def hps(*overrides: str) -> HPS:
    config = compose("capture", ["pipeline=hps", "recording=none", *overrides])
    return instantiate(config.pipeline, _convert_="all")


def pieces(recording: Recording, seconds: float = 1.0, lost: tuple[float, float] = (0.0, 0.0)) -> list[Recording]:
    """The recording cut into pieces; between the times `lost` no frame is localised."""
    suit, seen, camera, parts = recording.suit, recording.localization, recording.camera, []
    assert suit is not None and seen is not None and camera is not None  # noqa: PT018
    confidence = torch.where((seen.timestamps >= lost[0]) & (seen.timestamps < lost[1]), 0.0, seen.confidence)
    for start in torch.arange(0, recording.duration_s, seconds).tolist():
        first, stop = (int(torch.searchsorted(suit.timestamps, start + t)) for t in (0.0, seconds))
        here = (seen.timestamps >= start) & (seen.timestamps < start + seconds)
        cut = replace(
            seen,
            timestamps=seen.timestamps[here],
            R_world_cam=seen.R_world_cam[here],
            t_world_cam=seen.t_world_cam[here],
            confidence=confidence[here],
        )
        parts.append(
            replace(
                recording,
                suit=suit.sliced(first, stop),
                localization=cut,
                motion=None,
                contacts=None,
                camera=replace(camera, timestamps=camera.timestamps[here]),
            )
        )
    return parts


def followed(
    hps: HPS,
    parts: Iterable[Recording],
    scan: Scan | None,
    settings: StreamSettings | None = None,
    refused: Counter[str] | None = None,
) -> Iterator[Motion]:
    """Motion of a growing recording; `refused` counts what cannot be used."""
    stream, refused = None, Counter() if refused is None else refused
    for part in parts:
        sample = HpsSession.of_piece(hps, part, Path(), refused if stream else None)
        stream = stream or HpsStream(hps, part, scan, settings)
        stream.refused = refused
        if sample is not None:
            stream.take(sample)
            yield from filter(None, [stream.poses()])
    while stream is not None and (last := stream.poses(ended=True)) is not None:
        yield last


def root_error_cm(motions: list, recording: Recording) -> torch.Tensor:
    times = torch.cat([motion.timestamps for motion in motions])
    assert recording.motion is not None
    assert torch.allclose(times.diff(), torch.tensor(1 / 30, dtype=torch.float64), atol=1e-6)
    frame = torch.searchsorted(recording.motion.timestamps, times - 1e-6)
    return 100 * (torch.cat([m.t_world_root for m in motions]) - recording.motion.t_world_root[frame]).norm(dim=-1)


@pytest.fixture(scope="module")
def streamed():
    """A recording, what comes of it piece by piece, and how much of suit and camera was kept after each piece."""
    recording, kept = hps_recording(seconds=20.0), []
    push = HpsStream.push

    def watched(self, *args):
        done = push(self, *args)
        kept.append((len(self.suit), len(self.seen.timestamps)))
        return done

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HpsStream, "push", watched)
        online = list(followed(hps(), pieces(recording), Scan(floor_points()), settings=SETTINGS))
    return recording, online, kept


def test_every_frame_comes_once_and_in_order_nearly_as_good_as_offline(streamed):
    recording, online, _ = streamed
    offline = hps()(CaptureInput(recording, scan=Scan(floor_points())))
    assert sum(map(len, online)) == len(offline)
    assert len(online) > 10
    late = slice(120, None)
    assert root_error_cm(online, recording)[late].mean() < 1.6 * root_error_cm([offline], recording)[late].mean() + 0.5


def test_lost_localisation_is_bridged_by_the_suit():
    recording = hps_recording(seconds=24.0)
    motions = list(followed(hps(), pieces(recording, lost=(8.0, 16.0)), Scan(floor_points()), settings=SETTINGS))
    error = root_error_cm(motions, recording)
    assert error[8 * 30 : 16 * 30].max() < 40.0  # the suit alone is 16 cm off by then, and turned by 2°
    assert error[-60:].mean() < 6.0


def test_a_path_that_has_drifted_is_left_within_three_seconds():
    recording = hps_recording(seconds=18.0)
    assert recording.suit is not None
    share = ((recording.suit.timestamps - 8.0) / 4.0).clamp(0.0, 1.0).float()
    drift = share[:, None] * torch.tensor([0.5, -0.6, 0.0])
    drifting = replace(recording, suit=replace(recording.suit, t_world_root=recording.suit.t_world_root + drift))
    motions = list(followed(hps(), pieces(drifting, lost=(8.0, 12.0)), Scan(floor_points()), settings=SETTINGS))
    error = root_error_cm(motions, recording)
    assert error[int(11.0 * 30)] > 30.0
    assert error[15 * 30 :].max() < 10.0


def test_a_camera_that_falls_silent_for_longer_than_a_window_is_bridged_too():
    recording = hps_recording(seconds=20.0)
    stream = HpsStream(hps(), recording, Scan(floor_points()), SETTINGS)
    parts = pieces(recording)
    done = [stream.push(part.suit, part.localization if k < 5 else None) for k, part in enumerate(parts)]
    motions = [motion for motion in (*done, stream.finish()) if motion is not None]
    error = root_error_cm(motions, recording)
    assert len(error) == 600
    assert error.max() < 60.0  # the suit alone: 30 cm off by then, and turned by 3°


def test_no_more_than_a_window_is_kept(streamed):
    _, _, kept = streamed
    most = SETTINGS.window_s + SETTINGS.lag_s + 1.1
    assert max(suit for suit, _ in kept) <= most * 60
    assert max(seen for _, seen in kept) <= most * 30


def test_pieces_are_followed_until_the_end(tmp_path):
    parts = pieces(hps_recording(seconds=3.0))
    for number, part in enumerate(parts):
        write_piece(part, tmp_path, number)
    close_pieces(tmp_path)
    found = list(follow_pieces(tmp_path))
    assert [len(part.suit) for part in found] == [len(part.suit) for part in parts]
    _piece_path(tmp_path, 2).unlink()
    (tmp_path / "end").unlink()
    with pytest.raises(WearcapError, match="no piece 2 after"):
        list(follow_pieces(tmp_path, patience_s=0.2, poll_s=0.05))


def test_what_cannot_be_followed_is_refused_with_a_reason():
    clapping = hps_recording(seconds=2.0, camera_lead_s=0.3)
    with pytest.raises(WearcapError, match="clock=shared"):
        list(followed(hps(), pieces(clapping), None))
    parts = pieces(hps_recording(seconds=4.0))
    with pytest.raises(WearcapError, match="no scan of the scene, which the energy's term contact_plane needs"):
        list(followed(hps(), parts, None))
    never = pieces(hps_recording(seconds=3.0), lost=(0.0, 9.0))
    with pytest.raises(WearcapError, match="never localised"):
        list(followed(hps(), never, Scan(floor_points()), settings=SETTINGS))
