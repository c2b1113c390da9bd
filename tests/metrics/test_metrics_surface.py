"""Feet on a scanned slope: heights and slides that were put there are found."""

import math

import numpy as np
import pytest
import torch

from benchmarks.rivals.foot_surface import foot_surface, foot_vertices
from wearcap.body.anny_body import anny_body
from wearcap.body.kinematics import forward_kinematics
from wearcap.body.model import FOOT_REGIONS
from wearcap.body.skeleton import FOOT_PATCHES, xsens23
from wearcap.errors import WearcapError
from wearcap.geometry.surface import SurfaceIndex

SLOPE = 0.3


@pytest.fixture(scope="module")
def slope() -> SurfaceIndex:
    """A plane that rises by 0.3 m per metre of x, 2 mm of noise."""
    random = np.random.default_rng(0)
    xy = random.uniform(-1.5, 1.5, (120_000, 2))
    height = SLOPE * xy[:, 0] + 0.002 * random.normal(size=len(xy))
    return SurfaceIndex.build(np.concatenate([xy, height[:, None]], 1).astype(np.float32))


NORMAL = torch.tensor([-SLOPE, 0.0, 1.0]) / math.hypot(1.0, SLOPE)
UPHILL = torch.tensor([1.0, 0.0, SLOPE]) / math.hypot(1.0, SLOPE)


def on_slope(vertices: int) -> torch.Tensor:
    xy = torch.rand(vertices, 2, generator=torch.Generator().manual_seed(1)) - 0.5
    return torch.cat([xy, SLOPE * xy[:, :1]], 1)


def test_height_and_slide_are_measured_along_and_across_the_slope(slope: SurfaceIndex):
    shift = torch.arange(5.0)[:, None, None] * (0.01 * UPHILL)
    bounce = torch.tensor([0.02, 0.02, 0.02, 0.02, 0.02])[:, None, None] * NORMAL
    points = on_slope(30) + shift + bounce
    result = foot_surface(points, torch.ones(5, 30, dtype=torch.bool), slope)
    assert result.distance_cm == pytest.approx(2.0, abs=0.03)
    assert result.sliding_cm == pytest.approx(1.0, abs=0.01)
    assert (result.contacts, result.off_scan) == (150, 0)


def test_rising_from_the_surface_is_no_slide_and_signs_cancel_only_in_the_signed_mean(slope: SurfaceIndex):
    height = torch.tensor([-0.01, 0.01, -0.01, 0.01])[:, None, None] * NORMAL
    result = foot_surface(on_slope(40) + height, torch.ones(4, 40, dtype=torch.bool), slope)
    assert result.distance_cm == pytest.approx(0.0, abs=0.03)
    assert result.absolute_distance_cm == pytest.approx(1.0, abs=0.05)
    assert result.sliding_cm == pytest.approx(0.0, abs=0.02)


def test_only_frames_in_contact_count(slope: SurfaceIndex):
    points = on_slope(10).expand(6, 10, 3).clone()
    points[2:4] += torch.tensor([5.0, 0.0, 3.0])
    contact = torch.ones(6, 10, dtype=torch.bool)
    contact[2:4] = False
    result = foot_surface(points, contact, slope)
    assert result.sliding_cm == pytest.approx(0.0, abs=1e-6)
    assert result.contacts == 40
    lost = foot_surface(points, torch.ones(6, 10, dtype=torch.bool), slope)
    assert lost.off_scan == 20, "feet in mid-air far from the scan have no plane"
    assert math.isfinite(lost.distance_cm)


def test_without_contact_there_is_no_figure(slope: SurfaceIndex):
    result = foot_surface(on_slope(3)[None], torch.zeros(1, 3, dtype=torch.bool), slope)
    assert math.isnan(result.distance_cm)
    assert math.isnan(result.sliding_cm)
    assert result.contacts == 0


def test_patches_are_the_bodys_regions_in_their_order():
    skeleton = xsens23()
    body = anny_body(skeleton)
    pose = forward_kinematics(skeleton, torch.eye(3).expand(3, 23, 3, 3), torch.zeros(3, 3))
    contact = torch.zeros(3, 4, dtype=torch.bool)
    contact[1, FOOT_PATCHES.index("right_toe_tip")] = True
    points, touching = foot_vertices(body, pose, contact)
    assert tuple(FOOT_REGIONS) == FOOT_PATCHES
    assert not touching[[0, 2]].any()
    assert torch.equal(points[1][touching[1]], body.vertices(pose, "right_toes")[1])
    with pytest.raises(WearcapError, match="contacts of 2 frames for poses of 3"):
        foot_vertices(body, pose, contact[:2])
