"""Videos localised by key frames and tracked landmarks: what is tracked, lost, contradicted and covered."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from textured_room import CAMERA, looking, photo_poses, photograph, take_photos, textured_room

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.absolute_pose import CameraPose, Matches
from wearcap.localization.features import RootSift
from wearcap.localization.landmark_tracking import TrackingSettings, track_video
from wearcap.localization.localizer import Localizer
from wearcap.localization.map_builder import MapSettings, build_map
from wearcap.localization.point_map import PointMapper
from wearcap.localization.visual_map import VisualMap
from wearcap.recording.recording import Localization
from wearcap.scene.scan import Scan

EXTRACTOR = RootSift(600)
QUERY = Camera("opencv", 480, 270, 300.0, 300.0, 240.0, 134.0, (-0.08, 0.02, 0.001, 0.001))
FPS, COUNT = 15.0, 45
TIMES = torch.arange(COUNT, dtype=torch.float64) / FPS
SETTINGS = TrackingSettings(
    key_s=1.0,
    retry_s=0.25,
    landmarks=150,
    min_share=0.4,
    min_confidence=0.9,
    max_error_px=2.5,
    max_drift_m=0.01,
    window_px=15,
    max_side=480,
)
NEVER = replace(SETTINGS, key_s=100.0)
"""No regular key frame but the first."""


class Counting(Localizer):
    """Counts the frames that are localised in the map; those of `wrong` are displaced by a metre, landmarks included."""

    def __init__(self, visual_map: VisualMap, wrong: tuple[int, ...] = ()):
        super().__init__(visual_map, EXTRACTOR)
        self.wrong, self.count = wrong, 0

    def locate(self, picture, prior: Rigid | None = None) -> CameraPose | None:
        pose, self.count = super().locate(picture, prior), self.count + 1
        if pose is None or pose.matches is None or self.count - 1 not in self.wrong:
            return pose
        away = torch.tensor([1.0, 0.3, 0.0])
        matches = Matches(pose.matches.pixels, pose.matches.points_world + away.numpy(), pose.matches.camera)
        return replace(pose, t_world_cam=pose.t_world_cam + away, matches=matches)


def path(turn: float = 0.0) -> list[Rigid]:
    """A second and more of walking and looking about."""
    return [
        looking((1.5 + 0.03 * k, 2.0 + 0.01 * k, 1.6 + 0.02 * np.sin(k)), turn + 0.3 + 0.02 * k, 0.05 * np.sin(k / 4))
        for k in range(COUNT)
    ]


@pytest.fixture(scope="module")
def mapper() -> PointMapper:
    return PointMapper(textured_room(), 0.01)


@pytest.fixture(scope="module")
def room_map(mapper, tmp_path_factory) -> VisualMap:
    photos = take_photos(mapper, CAMERA, photo_poses(24), tmp_path_factory.mktemp("photos"))
    return build_map(photos, Scan(mapper.scan.points), EXTRACTOR, settings=MapSettings(splat_m=0.01, words=16))


@pytest.fixture(scope="module")
def video(mapper) -> list[np.ndarray]:
    return [photograph(mapper, QUERY, pose) for pose in path()]


def errors_cm(found: Localization, truth: list[Rigid]) -> torch.Tensor:
    return 100 * (found.t_world_cam - torch.stack([pose.t for pose in truth])).norm(dim=1)


def covered(video: list[np.ndarray], start: int, stop: int) -> list[np.ndarray]:
    """The video with a cloth before the camera."""
    return [np.full_like(f, 40) if start <= k < stop else f for k, f in enumerate(video)]


def test_frames_between_key_frames_are_as_good_as_key_frames(room_map, video):
    localizer, truth = Counting(room_map), path()
    found = track_video(video, TIMES, QUERY, localizer, SETTINGS)
    assert localizer.count == 3  # of 45 frames
    assert torch.equal(found.timestamps, TIMES)
    assert (found.confidence > 0.9).all()
    off = errors_cm(found, truth)
    assert off.max() < 1.5
    R = torch.stack([pose.R for pose in truth])
    assert rotation.geodesic(found.R_world_cam.double(), R).rad2deg().max() < 0.4
    turn = rotation.log(R @ found.R_world_cam.double().mT)
    error = torch.cat([turn, torch.stack([pose.t for pose in truth]) - found.t_world_cam.double()], 1)
    assert found.covariance is not None
    normalised = (error * torch.linalg.solve(found.covariance.double(), error)).sum(1) / 6
    assert 0.3 < normalised.mean() < 4  # 1 where errors of matches are independent


def test_frames_are_localised_anew_when_the_landmarks_leave(mapper, room_map, video):
    steady = Counting(room_map)
    track_video(video, TIMES, QUERY, steady, NEVER)
    turning = [looking((2.0, 2.0, 1.6), 0.08 * k) for k in range(COUNT)]
    localizer = Counting(room_map)
    found = track_video([photograph(mapper, QUERY, pose) for pose in turning], TIMES, QUERY, localizer, NEVER)
    assert steady.count < localizer.count < COUNT / 3
    assert (found.confidence > 0).all()
    assert errors_cm(found, turning).max() < 3


def test_a_jump_is_localised_at_once(mapper, room_map, video):
    truth = path()[:20] + path(turn=2.0)[20:]
    localizer = Counting(room_map)
    found = track_video(
        video[:20] + [photograph(mapper, QUERY, pose) for pose in truth[20:]], TIMES, QUERY, localizer, NEVER
    )
    assert localizer.count >= 2
    sure = found.confidence > 0.5
    assert sure[24:].all()
    assert errors_cm(found, truth)[sure].max() < 2


@pytest.mark.parametrize("wrong", [(0,), (1,), (2,), (0, 3)])
def test_a_wrong_key_frame_spoils_nothing(wrong, room_map, video):
    localizer = Counting(room_map, wrong)
    found = track_video(video, TIMES, QUERY, localizer, replace(SETTINGS, key_s=0.6))
    sure = found.confidence > 0
    assert errors_cm(found, path())[sure].max() < 2
    assert sure.double().mean() > 0.7  # what was seen only from the wrong one is withdrawn
    assert localizer.count > len(wrong) + 4


def test_a_camera_that_is_covered_and_uncovered(room_map, video):
    found = track_video(covered(video, 15, 28), TIMES, QUERY, Counting(room_map), NEVER)
    assert (found.confidence[15:28] == 0).all()
    assert found.covariance is not None
    assert found.covariance[20].diagonal().min() > 1
    torch.testing.assert_close(found.t_world_cam[20], found.t_world_cam[14])
    assert (found.confidence[28 + 4 :] > 0.9).all()  # found again within `retry_s`
    assert errors_cm(found, path())[found.confidence > 0].max() < 1.5


def test_a_hand_before_the_camera_is_not_followed(mapper, room_map, video):
    random = np.random.default_rng(3)
    hand = random.integers(0, 256, (140, 100, 3), dtype=np.uint8).repeat(2, 0)[:270].repeat(2, 1)[:, :200]
    frames = [frame.copy() for frame in video]
    for number, frame in enumerate(frames[10:35]):
        width = min(8 * number, 200)
        frame[:, :width] = hand[: frame.shape[0], -width:] if width else frame[:, :0]
    found = track_video(frames, TIMES, QUERY, Counting(room_map), SETTINGS)
    assert (found.confidence > 0).all()
    assert errors_cm(found, path()).max() < 2


def test_a_fisheye_is_tracked_in_its_undistorted_picture(mapper, room_map):
    fisheye = Camera("fisheye", 420, 420, 130.0, 130.0, 210.0, 209.0, (0.01, -0.004, 0.001, 0.0))
    truth = path()[:10]
    frames = [photograph(mapper, fisheye, pose) for pose in truth]
    found = track_video(frames, TIMES[:10], fisheye, Counting(room_map), SETTINGS)
    assert (found.confidence > 0.5).all()
    assert errors_cm(found, truth).max() < 4


def test_nothing_to_see_and_unequal_counts(room_map, video):
    nothing = track_video(covered(video, 0, COUNT), TIMES, QUERY, Counting(room_map), SETTINGS)
    assert not nothing.confidence.any()
    assert nothing.t_world_cam.isfinite().all()
    for count in (4, 6):
        with pytest.raises(WearcapError, match="timestamps"):
            track_video(video[:5], TIMES[:count], QUERY, Counting(room_map), SETTINGS)
    with pytest.raises(WearcapError, match="no intrinsics"):
        track_video(video[:5], TIMES[:5], None, Counting(room_map), SETTINGS)
    with pytest.raises(WearcapError, match="calibration for 480x270"):
        track_video([video[0], video[1][:-2]], TIMES[:2], QUERY, Counting(room_map), SETTINGS)


@pytest.mark.parametrize(
    "change",
    [{"retry_s": 0.0}, {"key_s": 0.1}, {"landmarks": 3}, {"min_share": 1.0}, {"window_px": 2}, {"max_side": 16}],
)
def test_settings_that_cannot_be_are_refused(change):
    with pytest.raises(WearcapError, match="tracking with"):
        replace(SETTINGS, **change)
