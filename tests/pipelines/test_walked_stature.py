"""The wearer's height by how straight legs are that bear weight: found where it must be, and left alone where nothing shows it."""

from dataclasses import dataclass, replace

import pytest
import torch

from wearcap.body.skeleton import skeleton_of_height, xsens23
from wearcap.geometry import rotation
from wearcap.metrics.gait import crouches, normal_knee_deg
from wearcap.recording import FloorTrack, Motion, PointCloud, Recording
from wearcap.runtime.system import Captured, CaptureInput, System
from wearcap.runtime.walked_stature import with_walked_stature
from wearcap.tracking.stature import Stature

FOUND = Stature(1.70, 0.025, "head")


def walk(bent_deg: float, seconds: float = 6.0, fps: float = 60.0) -> Motion:
    """Somebody who walks ahead at 1.2 m/s with knees that are bent by so much more than people's; ankles stay level."""
    skeleton = xsens23()
    times = torch.arange(int(seconds * fps), dtype=torch.float64) / fps
    phase = times.float() / 1.1
    curve = normal_knee_deg()
    R = torch.eye(3).repeat(len(times), len(skeleton), 1, 1)
    for side, later in (("left", 0.0), ("right", 0.5)):
        knee = curve[(100 * ((phase + later) % 1)).long()] + bent_deg
        R[:, skeleton.index(f"{side}_knee")] = rotation.about_axis("y", knee.deg2rad())
    root = torch.stack([1.2 * times.float(), 0 * phase, 1.0 + 0 * phase], 1)
    return Motion(times, skeleton, R, root)


@dataclass
class Walker(System):
    """A system whose captures bend their knees by 300 degrees for each metre of height above 1.68, and no other value."""

    per_m: float = 300.0
    asked: int = 0

    def capture(self, sources, seeds, options=None) -> list[Captured]:
        self.asked += len(sources)
        return [Captured(walk(self.per_m * (s.recording.skeleton.stature - 1.68))) for s in sources]


def source(points: bool = True, floor: bool = False) -> CaptureInput:
    cloud = PointCloud(torch.zeros(10, 3)) if points else None
    ground = FloorTrack(torch.zeros(1, dtype=torch.float64), torch.zeros(1)) if floor else None
    return CaptureInput(Recording("walk", points=cloud, floor=ground))


def test_the_height_is_between_what_the_head_and_the_knees_say():
    # People's stance is bent by 11 degrees here at 1.68 m: both estimates are equally sure of what they say.
    given, walked = with_walked_stature(Walker(), source(), FOUND, xsens23())
    assert given.recording.skeleton.stature == pytest.approx(walked.height_m)
    assert 1.675 < walked.height_m < 1.695
    assert walked.deviation_m < FOUND.deviation_m
    assert "1.69 ± 0.02" in str(walked)
    assert with_walked_stature(Walker(), source(False, floor=True), FOUND, xsens23())[1] == walked
    _, sure = with_walked_stature(Walker(), source(), replace(FOUND, deviation_m=0.005), xsens23())
    assert abs(sure.height_m - 1.70) < abs(walked.height_m - 1.70), "the head is believed as far as it is sure"
    _, blind = with_walked_stature(Walker(per_m=0.0), source(), FOUND, xsens23())
    assert blind.height_m == pytest.approx(1.70, abs=1e-4), "knees that do not change say nothing"


@pytest.mark.parametrize(
    ("found", "points"),
    [(replace(FOUND, source="given"), True), (replace(FOUND, source="skeleton"), True), (FOUND, False)],
)
def test_a_height_that_is_known_or_cannot_be_seen_stays(found, points):
    walker, given = Walker(), source(points)
    assert with_walked_stature(walker, given, found, xsens23()) == (given, found)
    assert walker.asked == 0


def test_somebody_who_stands_keeps_the_first_estimate():
    standing = replace(walk(0.0), t_world_root=torch.zeros(360, 3))
    walker = Walker()
    walker.capture = lambda sources, seeds: [Captured(standing) for _ in sources]
    given = source()
    assert with_walked_stature(walker, given, FOUND, xsens23()) == (given, FOUND)


def test_who_walks_on_bent_knees_is_named():
    assert crouches(walk(0.0)) is None
    assert crouches(walk(25.0)) == pytest.approx(36, abs=3)
    assert crouches(replace(walk(25.0), t_world_root=torch.zeros(360, 3))) is None, "no walk"
    assert skeleton_of_height(1.7, xsens23()).stature == pytest.approx(1.7)
