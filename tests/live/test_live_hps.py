"""HPS live: single frames of a suit and of a localised camera become registered poses, every second."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines"))

from hps_walk import floor_points, hps_recording
from hydra.utils import instantiate
from test_hps_stream import pieces

import planted_hands as planted
from wearcap.apps.live.capture import LiveCapture
from wearcap.apps.live.setup import Known
from wearcap.apps.live.sink import Sink
from wearcap.apps.live.sources.replay import ReplaySource
from wearcap.body.hands import has_fingers
from wearcap.cli.capture import main as capture
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.io.formats.motion_npz import read_motion
from wearcap.recording import Motion
from wearcap.recording.pieces import close_pieces, write_piece
from wearcap.recording.timing import joined
from wearcap.runtime.system import CaptureInput
from wearcap.scene.scan import Scan
from wearcap.sensors.samples import LocalizationSample, SuitPiece
from wearcap.systems.hmd2.stream import HMD2Session
from wearcap.systems.hps.stream import HpsSession, HpsStream


class Kept(Sink):
    name = convention = "kept"

    def __init__(self):
        self.pieces: list[Motion] = []

    def take(self, wearer: str, motion: Motion) -> None:
        self.pieces.append(motion)


def test_a_suit_and_a_localised_camera_become_registered_poses():
    recording = hps_recording()
    system = instantiate(compose("capture", ["pipeline=hps", "recording=none"]).pipeline, _convert_="all")
    source, kept = ReplaySource(recording, HpsSession, math.inf), Kept()
    place = CaptureInput(recording, scan=Scan(floor_points()))
    report = LiveCapture(system, [source], [kept], source=place, known=Known(setup=source.setup)).run(120.0)
    motion = joined(kept.pieces)
    assert motion is not None and recording.motion is not None  # noqa: PT018
    frame = torch.searchsorted(recording.motion.timestamps, motion.timestamps - 1e-6)
    off = (motion.t_world_root - recording.motion.t_world_root[frame]).norm(dim=-1)
    assert 100 * off.mean() < 6.0
    assert len(motion) > 28 * 30
    assert report["wearers"]["wearer"]["refused"] == {}
    assert report["wearers"]["wearer"]["sessions"] == 1


def test_frames_out_of_order_and_doubled_are_sorted_and_bad_ones_counted():
    recording = hps_recording(seconds=8.0)
    system = instantiate(compose("capture", ["pipeline=hps", "recording=none"]).pipeline, _convert_="all")
    session = HpsSession(system, [recording], Scan(floor_points()))
    suit, seen = recording.suit, recording.localization
    assert suit is not None and seen is not None  # noqa: PT018
    order, parts = list(range(len(suit))), []
    for k in range(0, len(order) - 1, 7):
        order[k], order[k + 1] = order[k + 1], order[k]
    for k in order:
        samples = [SuitPiece(suit.sliced(k, k + 1))] * (2 if k % 50 == 3 else 1)
        if k % 2 == 0 and k // 2 < len(seen.timestamps):
            pose = Rigid(seen.R_world_cam[k // 2], seen.t_world_cam[k // 2])
            samples.append(LocalizationSample(seen.timestamps[k // 2].item(), pose))
            if k == 100:
                samples.append(LocalizationSample(float("nan"), pose))
        session.push([samples])
        if (motion := session.poses()[0]) is not None:
            parts.append(motion)
    # After the first five localised seconds poses come twice a second, a second late.
    assert len(parts) >= 4
    ends = torch.tensor([part.timestamps[-1].item() for part in parts])
    assert ends[0] >= 3.5
    assert ends.diff().max() <= 0.6
    assert set(session.refused[0]) <= {"localization: not finite", "suit: late"}
    assert session.refused[0]["localization: not finite"] == 1
    assert sum(len(part) for part in parts) == len(torch.cat([part.timestamps for part in parts]).unique())


def test_a_growing_recording_becomes_the_motion_of_its_pieces(tmp_path):
    growing, pipeline = tmp_path / "growing", "pipeline=paper/hps_without_scene"
    parts = pieces(hps_recording(seconds=8.0))
    parts[3] = replace(parts[3], localization=None, camera=None)
    for number, part in enumerate(parts):
        write_piece(replace(part, suit=None) if number == 5 else part, growing, number)
    close_pieces(growing)
    capture([pipeline, "live=true", f"recording={growing}", f"output={tmp_path}", f"hydra.run.dir={tmp_path}"])
    system = instantiate(compose("capture", [pipeline, "recording=none"]).pipeline, _convert_="all")
    stream, expected = HpsStream(system, parts[0], None), []
    for number, part in enumerate(parts):
        expected.append(None if number == 5 else stream.push(part.suit, part.localization))
    whole = joined([part for part in (*expected, stream.finish()) if part is not None])
    found = read_motion(tmp_path / "wearer" / "motion.npz")
    assert whole is not None
    torch.testing.assert_close(found.timestamps, whole.timestamps, rtol=0, atol=0)
    torch.testing.assert_close(found.t_world_root, whole.t_world_root, rtol=0, atol=0)
    torch.testing.assert_close(found.R_parent_joint, whole.R_parent_joint, rtol=0, atol=1e-6)


def test_a_growing_recording_has_its_hands_fingers(tmp_path):
    parts, growing = pieces(hps_recording(seconds=8.0)), tmp_path / "growing"
    for number, part in enumerate(parts):
        times = part.suit.timestamps
        hand = planted.stream(planted.joints(planted.moving(len(times), number), "left"))
        write_piece(replace(part, fingers={"left": replace(hand, timestamps=times)}), growing, number)
    close_pieces(growing)
    capture(
        [
            "pipeline=paper/hps_without_scene",
            "live=true",
            f"recording={growing}",
            f"output={tmp_path}",
            f"hydra.run.dir={tmp_path}",
        ]
    )
    motion = read_motion(tmp_path / "wearer" / "motion.npz")
    assert has_fingers(motion.skeleton)
    assert motion.fingers_measured is not None
    assert motion.fingers_measured[:, 0].mean() > 0.95
    assert not motion.fingers_measured[:, 1].any()


def test_a_system_that_follows_no_growing_recording_says_so():
    with pytest.raises(WearcapError, match="cannot follow a growing recording"):
        HMD2Session.of_piece(None, hps_recording(seconds=1.0), Path(), None)
