"""Chamfer distance: on figures where it is known, and what it refuses."""

import pytest
import torch

from benchmarks.rivals import hps_scores
from wearcap.errors import WearcapError
from wearcap.metrics.surface import Chamfer, chamfer

mean_chamfer = hps_scores.mean_chamfer


def square(side: float, cells: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A horizontal square of triangles at z = 0, the origin in its middle."""
    axis = torch.linspace(-side / 2, side / 2, cells + 1)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    first = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).reshape(-1, 1)
    quad = torch.tensor([[0, cells + 1, cells + 2], [0, cells + 2, 1]])
    return vertices, (first[:, None] + quad).reshape(-1, 3)


def test_a_cloud_held_above_a_square_has_its_height_as_distance():
    vertices, faces = square(1.0, 10)
    cloud = torch.rand(20000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    cloud[:, 2] = 0.03
    result = chamfer(vertices, cloud, faces=faces)
    assert result.cloud_to_body_cm == pytest.approx(3.0, abs=1e-4)
    assert 3.0 < result.body_to_cloud_cm < 3.05
    literal = chamfer(vertices, cloud)
    assert literal.body_to_cloud_cm == result.body_to_cloud_cm
    assert literal.cloud_to_body_cm > 4.0, "vertices 10 cm apart: the literal form measures that too"
    assert result.mean_cm == pytest.approx((3.0 + result.body_to_cloud_cm) / 2, abs=1e-4)


def test_frames_are_averaged_direction_by_direction():
    mean = mean_chamfer([Chamfer(1.0, 2.0), Chamfer(3.0, 6.0)])
    assert (mean.cloud_to_body_cm, mean.body_to_cloud_cm, mean.mean_cm) == (2.0, 4.0, 3.0)


@pytest.mark.parametrize(
    "call",
    [
        lambda body: chamfer(body, torch.zeros(0, 3)),
        lambda body: chamfer(body, torch.full((5, 3), torch.nan)),
        lambda body: chamfer(body[:0], body),
        lambda body: mean_chamfer([]),
    ],
    ids=["empty cloud", "NaN", "no vertex", "no frames"],
)
def test_what_cannot_be_measured_is_refused(call):
    vertices, _ = square(1.0, 2)
    with pytest.raises(WearcapError):
        call(vertices)
