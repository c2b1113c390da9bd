"""A growing recording of which pieces are bad: they are refused and counted, and the motion goes on."""

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch
from hps_walk import hps_recording
from hydra.utils import instantiate
from test_hps_stream import followed, pieces

from bad_packets import Mutator, broken, unchecked
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.recording import Motion, Recording
from wearcap.recording.pieces import _piece_path, close_pieces, follow_pieces, write_piece
from wearcap.systems.hps import stream as hps_stream
from wearcap.systems.hps.energy import Solution
from wearcap.systems.hps.pipeline import HPS
from wearcap.systems.hps.stream import HpsStream, StreamSettings

SETTINGS = StreamSettings(start_s=1.0, window_s=3.0)
SECONDS, FAULT = 8, 4


@pytest.fixture(scope="module")
def hps() -> HPS:
    """One that believes its start: what is tested is what reaches it."""
    config = compose("capture", ["pipeline=paper/hps_without_scene", "recording=none"])
    made = instantiate(config.pipeline, _convert_="all")
    made.solver = lambda energy, data: Solution(data.start, [], "start")
    return made


@pytest.fixture(scope="module")
def parts() -> list[Recording]:
    return pieces(hps_recording(seconds=float(SECONDS)))


def shifted(piece: Recording, by_s: float) -> Recording:
    suit, seen = piece.suit, piece.localization
    return replace(
        piece,
        suit=replace(suit, timestamps=suit.timestamps + by_s),
        localization=replace(seen, timestamps=seen.timestamps + by_s),
        camera=replace(piece.camera, timestamps=piece.camera.timestamps + by_s),
    )


def bad_suits(suit: Motion) -> dict:
    t, R, times = suit.t_world_root, suit.R_parent_joint, suit.timestamps
    hole = t.clone()
    hole[7, 1] = math.nan
    return {
        "nan": broken(suit, t_world_root=hole),
        "large": broken(suit, t_world_root=t + 1e30),
        "short": broken(suit, t_world_root=t[:-1]),
        "integer": broken(suit, t_world_root=t.long()),
        "none": broken(suit, t_world_root=None),
        "joints": broken(suit, R_parent_joint=R[:, :-1]),
        "scaled": broken(suit, R_parent_joint=2 * R),
        "infinite": broken(suit, R_parent_joint=R / 0),
        "backwards": broken(suit, timestamps=times.flip(0)),
        "repeated": broken(suit, timestamps=0 * times),
        "no time": broken(suit, timestamps=times * math.nan),
        "far": broken(suit, timestamps=times + 1e18),
        "one far": broken(suit, timestamps=torch.cat([times[:-1], times[-1:] + 1e9])),
        "no contact": broken(suit, contact_prob=None),
        "contact": broken(suit, contact_prob=suit.contact_prob + 9),
        "few contacts": broken(suit, contact_prob=suit.contact_prob[:3]),
        "nothing": None,
        "text": "suit",
    }


def bad_localizations(seen) -> dict:
    R, t, times = seen.R_world_cam, seen.t_world_cam, seen.timestamps
    return {
        "nan": broken(seen, t_world_cam=t * math.nan),
        "large": broken(seen, t_world_cam=t + 1e30),
        "scaled": broken(seen, R_world_cam=3 * R),
        "short": broken(seen, R_world_cam=R[:-1]),
        "none": broken(seen, R_world_cam=None),
        "backwards": broken(seen, timestamps=times.flip(0)),
        "confidence": broken(seen, confidence=seen.confidence * math.nan),
        "ahead": broken(seen, timestamps=times + 60),
        "again": broken(seen, timestamps=times - 2.0),
        "text": "seen",
    }


def run(stream: HpsStream, parts: list[Recording]) -> list[Motion]:
    motions = [unchecked(stream.push)(part.suit, part.localization) for part in parts]
    return [motion for motion in (*motions, stream.finish()) if motion is not None]


def times_of(motions: list[Motion]) -> torch.Tensor:
    return torch.cat([motion.timestamps for motion in motions])


@pytest.fixture(scope="module")
def undisturbed(hps, parts):
    return run(HpsStream(hps, parts[0], None, SETTINGS), parts)


def test_bad_pieces_in_between_change_nothing(hps, parts, undisturbed):
    stream, bad = HpsStream(hps, parts[0], None, SETTINGS), bad_suits(parts[FAULT].suit)
    motions = [stream.push(part.suit, part.localization) for part in parts[:FAULT]]
    for suit in bad.values():
        assert unchecked(stream.push)(suit, parts[FAULT].localization) is None
    found = [motion for motion in motions if motion is not None] + run(stream, parts[FAULT:])
    assert sum(stream.refused.values()) == len(bad)
    assert all(reason.startswith("suit: ") for reason in stream.refused)
    for motion, expected in zip(found, undisturbed, strict=True):
        assert torch.equal(motion.t_world_root, expected.t_world_root)
        assert torch.equal(motion.R_parent_joint, expected.R_parent_joint)


@pytest.mark.parametrize("name", bad_localizations(pieces(hps_recording(seconds=1.0))[0].localization))
def test_bad_camera_poses_are_bridged_by_the_suit(hps, parts, undisturbed, name):
    seen = bad_localizations(parts[FAULT].localization)[name]
    given = [broken(part, localization=seen) if k == FAULT else part for k, part in enumerate(parts)]
    stream = HpsStream(hps, parts[0], None, SETTINGS)
    found = run(stream, given)
    assert sum(stream.refused.values()) == 1
    assert torch.equal(times_of(found), times_of(undisturbed))
    off = torch.cat([m.t_world_root for m in found]) - torch.cat([m.t_world_root for m in undisturbed])
    assert off.norm(dim=-1).max() < 0.3


def test_a_piece_is_missing_or_comes_twice(hps, parts, undisturbed):
    given = [*parts[:4], parts[2], *parts[5:]]
    refused = Counter()
    found = list(followed(hps, given, None, settings=SETTINGS, refused=refused))
    assert refused == {"suit: off the clock": 1}
    assert torch.equal(times_of(found), times_of(undisturbed))
    assert all(motion.t_world_root.isfinite().all() for motion in found)


@pytest.mark.parametrize("by_s", [-5.0, -1000.0, 3600.0, 1e9])
def test_where_the_clock_moves_a_new_stretch_begins(hps, parts, undisturbed, by_s):
    refused, odd = Counter(), shifted(parts[2], 500.0)
    given = [*parts[:3], odd, *parts[3:], *(shifted(part, SECONDS + by_s) for part in parts)]
    found = list(followed(hps, given, None, settings=SETTINGS, refused=refused))
    assert refused == {"suit: off the clock": 1}
    assert all((motion.timestamps.diff() > 0).all() for motion in found)
    first = times_of(undisturbed)
    expected = torch.cat([first, first + SECONDS + by_s])
    assert torch.allclose(times_of(found), expected, atol=1 / 30)
    assert all(motion.t_world_root.isfinite().all() for motion in found)


def test_where_every_piece_is_bad_it_is_reported(hps, parts):
    given = [broken(part, suit=broken(part.suit, t_world_root=part.suit.t_world_root * math.nan)) for part in parts]
    with pytest.raises(WearcapError, match="no piece can be used .suit: not finite."):
        list(followed(hps, given, None, settings=SETTINGS))


def test_pieces_without_a_suit_or_a_readable_file_are_passed_over(hps, parts, tmp_path):
    for number, part in enumerate(parts):
        write_piece(replace(part, suit=None) if number == 3 else part, tmp_path, number)
    close_pieces(tmp_path)
    _piece_path(tmp_path, 5).write_bytes(b"nothing")
    refused = Counter()
    found = list(followed(hps, follow_pieces(tmp_path, refused=refused), None, settings=SETTINGS, refused=refused))
    assert refused == {"piece: damaged file": 1, "suit: wrong type or shape": 1}
    assert times_of(found)[-1] > SECONDS - 0.1
    with pytest.raises(WearcapError):
        list(follow_pieces(tmp_path))


def test_a_suit_that_is_never_localised_is_not_kept_forever(hps, parts, monkeypatch):
    monkeypatch.setattr(hps_stream, "MAX_UNALIGNED_S", 4.0)
    stream = HpsStream(hps, parts[0], None, SETTINGS)
    for lap in range(3):
        for part in parts:
            stream.push(shifted(part, lap * float(SECONDS)).suit)
    assert len(stream.suit) <= 5.1 * 60


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_it_goes_on(hps, parts, seed):
    stream, draw, motions = HpsStream(hps, parts[0], None, SETTINGS), Mutator(seed, 0.2), []
    for k in range(40):
        piece = shifted(parts[k % SECONDS], float(k - k % SECONDS))
        if draw.bad():
            piece = shifted(piece, float(draw.random.normal(scale=draw.random.choice([1.0, 1000.0]))))
        suit = draw.one(bad_suits(piece.suit)) if draw.bad() else piece.suit
        seen = draw.one(bad_localizations(piece.localization)) if draw.bad() else piece.localization
        motions.append(unchecked(stream.push)(suit, seen))
    motions += [stream.push(shifted(part, 40.0).suit, shifted(part, 40.0).localization) for part in parts]
    motions = [motion for motion in (*motions, stream.finish()) if motion is not None]
    assert motions[-1].timestamps[-1] > 40 + SECONDS - 0.1
    for motion in motions:
        assert motion.R_parent_joint.isfinite().all()
        assert motion.t_world_root.isfinite().all()
    assert len(stream.suit) < 10 * 60
