"""Keypoints between detections on a video of a textured patch that moves over a textured ground."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from data_prep.keypoint_detectors import Detector, Keypoint, RecordedDetections
from data_prep.keypoint_flow import FlowSettings, KeypointFlow, tracked_cues
from wearcap.errors import WearcapError
from wearcap.recording import Cue

HEIGHT, WIDTH, SIDE = 240, 320, 61


def texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Grey spots of many sizes, the larger ones stronger, as pictures have them."""
    total = np.zeros((height, width), np.float32)
    for size in (3, 6, 12, 24):
        spots = rng.standard_normal((height // size + 2, width // size + 2)).astype(np.float32)
        total += size**0.5 * cv2.resize(spots, (width, height), interpolation=cv2.INTER_CUBIC)
    grey = np.clip(128 + 40 * total / total.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, 2)


def place(frame: float) -> np.ndarray:
    """Middle of the patch: a curve with up to 7 px per frame."""
    return np.array([70 + 4.5 * frame, 120 + 35 * np.sin(frame / 5.0)])


def video(frames: int, hidden: range = range(0), pillar: tuple[int, int] = (0, 0)) -> list[np.ndarray]:
    """The patch between pixels, with some noise; in the `hidden` frames another texture lies over all, and always over
    the columns of a `pillar`."""
    rng = np.random.default_rng(0)
    ground, patch, cover = texture(rng, HEIGHT, WIDTH), texture(rng, SIDE, SIDE), texture(rng, HEIGHT, WIDTH)
    shown = []
    for frame in range(frames):
        x, y = place(frame) - (SIDE - 1) / 2
        shift = np.array([[1, 0, x], [0, 1, y]])
        moved = cv2.warpAffine(patch, shift, (WIDTH, HEIGHT))
        mask = cv2.warpAffine(np.ones((SIDE, SIDE), np.float32), shift, (WIDTH, HEIGHT))[..., None]
        picture = mask * moved + (1 - mask) * ground
        picture[:, slice(*pillar)] = cover[:, slice(*pillar)]
        noisy = (cover if frame in hidden else picture) + 4 * rng.standard_normal(cover.shape)
        shown.append(noisy.clip(0, 255).astype(np.uint8))
    return shown


def detections(at: dict[int, float]) -> RecordedDetections:
    """The truth at some frames of 30 Hz, with these confidences."""
    frames = list(at)
    times = torch.tensor(frames, dtype=torch.float64) / 30
    points = torch.from_numpy(np.stack([place(frame) for frame in frames])).float()
    return RecordedDetections(
        {"left_wrist": Cue(times, "left_wrist", points, torch.tensor([at[f] for f in frames]).float())}, 0.01
    )


def followed(pictures: list[np.ndarray], detector: Detector, settings=FlowSettings()) -> tuple[np.ndarray, Cue]:
    """Frames at which the wrist is seen, and its cue."""
    times = torch.arange(len(pictures), dtype=torch.float64) / 30
    cue = tracked_cues(iter(pictures), times, detector, settings)["left_wrist"]
    return np.rint(30 * cue.timestamps.numpy()).astype(int), cue


def error_px(frames: np.ndarray, cue: Cue) -> np.ndarray:
    return np.linalg.norm(cue.points.numpy() - np.stack([place(frame) for frame in frames]), axis=1)


def test_a_gap_between_detections_is_filled():
    frames, cue = followed(video(14), detections({0: 0.9, 1: 0.9, 12: 0.6, 13: 0.6}))
    assert frames.tolist() == list(range(14))
    assert error_px(frames, cue).max() < 1.0
    sure = cue.confidence.numpy()
    assert sure[[0, 1, 12, 13]] == pytest.approx([0.9, 0.9, 0.6, 0.6])
    assert sure[2:12].max() < 0.9
    assert (np.diff(sure[1:7]) < 0).all()


def test_what_is_followed_from_one_side_fades_and_ends():
    settings = FlowSettings(reach=6)
    frames, cue = followed(video(30), detections({10: 0.8}), settings)
    assert frames.tolist() == list(range(4, 17))
    assert error_px(frames, cue).max() < 1.5
    assert cue.confidence.numpy() == pytest.approx([0.8 * (1 - abs(f - 10) / 7) for f in frames], abs=1e-5)
    frames, cue = followed(video(30), detections({10: 0.8}), replace(settings, reach=0))
    assert frames.tolist() == [10]


def test_a_hidden_keypoint_is_lost():
    for at in ({0: 1.0, 1: 1.0}, {0: 1.0, 1: 1.0, 11: 1.0}):
        frames, cue = followed(video(12, hidden=range(5, 9)), detections(at))
        assert not set(range(5, 9)) & set(frames.tolist())
        assert error_px(frames, cue).max() < 1.5
        assert set(range(5)) <= set(frames.tolist())
    frames, _ = followed(video(12, hidden=range(5, 9)), detections({0: 1.0, 11: 1.0}))
    assert {9, 10} <= set(frames.tolist())


def test_what_passes_behind_a_pillar_is_lost_there():
    frames, cue = followed(video(27, pillar=(100, 160)), detections({0: 1.0, 26: 1.0}))
    behind = [frame for frame in range(27) if 100 <= place(frame)[0] < 160]
    assert not set(behind) & set(frames.tolist())
    assert {0, 1, 25, 26} <= set(frames.tolist())
    assert error_px(frames, cue).max() < 2.0


def test_tracks_that_part_are_no_keypoint():
    """A detection on the ground and one on the patch: both can be followed, but not as one."""

    class Wrong:
        joints = ("left_wrist",)

        def __call__(self, picture, time_s):
            found = {0: Keypoint(30.0, 30.0, 1.0), 8: Keypoint(*place(8), 1.0)}
            frame = round(30 * time_s)
            return {"left_wrist": found[frame]} if frame in found else {}

    frames, _ = followed(video(9), Wrong())
    assert frames.tolist() == [0, 8]


def test_several_keypoints_at_once_are_as_one_by_one():
    pictures, rng = video(12), np.random.default_rng(1)
    at = {f"p{k}": place(0) + rng.uniform(-15, 15, 2) for k in range(4)} | {"still": np.array([290.0, 30.0])}
    flow = KeypointFlow(tuple(at))
    alone = {name: KeypointFlow((name,)) for name in at}
    spotted, single = [], {name: [] for name in at}
    for number, picture in enumerate(pictures):
        found = {name: Keypoint(*where, 1.0) for name, where in at.items()} if number == 0 else {}
        spotted += flow.advance(picture, found)
        for name, one in alone.items():
            single[name] += one.advance(picture, {key: found[key] for key in found if key == name})
    spotted += flow.finish()
    assert len(spotted) == len(pictures)
    assert (spotted[-1].confidence > 0).all()
    np.testing.assert_allclose(spotted[-1].pixels[-1], at["still"], atol=0.1)
    for column, (name, one) in enumerate(alone.items()):
        whole = single[name] + one.finish()
        np.testing.assert_allclose([s.pixels[column] for s in spotted], [s.pixels[0] for s in whole], atol=0.02)


def test_a_video_is_not_held_whole():
    """Frames come back as soon as nothing behind can add to them, and are let go."""
    flow, detector = KeypointFlow(("left_wrist",), FlowSettings(reach=4)), detections({0: 1.0, 20: 1.0})
    counts = []
    for number, picture in enumerate(video(24)):
        counts.append(len(flow.advance(picture, detector(picture, number / 30))))
        assert len(flow._frames) <= 4
    assert counts == [0] * 4 + [1] * 20
    assert len(flow.finish()) == 4


def test_what_does_not_fit_is_refused():
    with pytest.raises(WearcapError, match="5 pictures for 6 timestamps"):
        tracked_cues(video(5), torch.arange(6, dtype=torch.float64) / 30, detections({0: 1.0}))
    with pytest.raises(WearcapError, match="more pictures for 4 timestamps"):
        tracked_cues(video(5), torch.arange(4, dtype=torch.float64) / 30, detections({0: 1.0}))
    sizes = [np.zeros((240, 320, 3), np.uint8), np.zeros((200, 320, 3), np.uint8)]
    with pytest.raises(WearcapError, match="after one of 320x240"):
        tracked_cues(sizes, torch.arange(2, dtype=torch.float64), detections({0: 1.0}))
    with pytest.raises(WearcapError, match="3 coordinates"):
        RecordedDetections({"head": Cue(torch.zeros(1).double(), "head", torch.zeros(1, 3), torch.ones(1))}, 0.1)
    with pytest.raises(WearcapError, match="flow over -1 frames"):
        FlowSettings(reach=-1)
    assert isinstance(detections({0: 1.0}), Detector)
    assert tracked_cues([], torch.zeros(0, dtype=torch.float64), detections({0: 1.0})) == {}
