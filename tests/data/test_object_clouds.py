"""Clouds of objects: even by area, the same for a seed; generated objects, their splits, their variation, their file."""

from functools import partial

import numpy as np
import pytest
import torch

from wearcap.data.datamodule import Loading, WindowsModule
from wearcap.data.draws import Draws
from wearcap.data.objects import object_cloud
from wearcap.errors import WearcapError
from wearcap.geometry.mesh import Mesh
from wearcap.systems.echo.object_training import CloudAugmentation, ObjectClouds
from wearsim.places.object_clouds import generate_clouds

CLASSES = ["box", "chair", "drawer", "door"]


def mesh_of(vertices: list, faces: list) -> Mesh:
    return Mesh(
        np.array(vertices, np.float32).reshape(-1, 3), np.array(faces, np.int32).reshape(-1, 3), np.zeros(3, np.float32)
    )


def two_triangles() -> Mesh:
    """One of 3 m² at z = 0, one of 1 m² at z = 5."""
    low, high = [[0, 0, 0], [3, 0, 0], [0, 2, 0]], [[0, 0, 5], [2, 0, 5], [0, 1, 5]]
    return mesh_of([*low, *high], [[0, 1, 2], [3, 4, 5]])


def test_a_cloud_is_even_by_area_and_the_same_again():
    cloud = object_cloud(two_triangles(), 4000)
    assert cloud.shape == (4000, 3)
    low = cloud[cloud[:, 2] == 0]
    assert abs(len(low) - 3000) <= 1
    assert ((low[:, 0] / 3 + low[:, 1] / 2) <= 1 + 1e-5).all()
    # a quarter of a triangle's area lies beyond half of its way to a corner
    assert (low[:, 0] > 1.5).float().mean() == pytest.approx(0.25, abs=0.03)
    assert (low[:, 1] > 1.0).float().mean() == pytest.approx(0.25, abs=0.03)
    assert (low[:, 0] / 3 + low[:, 1] / 2 < 0.5).float().mean() == pytest.approx(0.25, abs=0.03)
    assert torch.equal(cloud, object_cloud(two_triangles(), 4000))
    assert not torch.equal(cloud, object_cloud(two_triangles(), 4000, seed=1))
    assert object_cloud(two_triangles()).shape == (1500, 3)


def test_without_faces_the_vertices_are_drawn():
    vertices = np.random.default_rng(0).normal(size=(40, 3)).tolist()
    cloud = object_cloud(mesh_of(vertices, []), 100)
    _, counts = cloud.unique(dim=0, return_counts=True)
    assert len(counts) == 40
    assert set(counts.tolist()) == {2, 3}
    assert len(object_cloud(mesh_of(vertices, []), 7).unique(dim=0)) == 7


def test_meshes_that_are_no_surface_are_refused():
    with pytest.raises(WearcapError, match="0 vertices"):
        object_cloud(mesh_of([], []))
    with pytest.raises(WearcapError, match="NaN or infinite"):
        object_cloud(mesh_of([[0, 0, float("nan")]], []))


def test_objects_of_splits_differ_and_are_generated_alike():
    clouds, labels = generate_clouds("train", CLASSES, 3, 100)
    assert clouds.shape == (12, 100, 3)
    assert labels.bincount().tolist() == [3, 3, 3, 3]
    assert torch.equal(clouds, generate_clouds("train", CLASSES, 3, 100)[0])
    assert not any(torch.equal(a, b) for a in clouds for b in generate_clouds("val", CLASSES, 3, 100)[0])
    assert len({tuple(cloud.amax(0).tolist()) for cloud in clouds}) == 12
    with pytest.raises(WearcapError, match="no objects of class 'piano'"):
        generate_clouds("train", ["piano"], 1)


def views(augmentation: CloudAugmentation, points: torch.Tensor, *seeds: int) -> torch.Tensor:
    return augmentation(points.expand(len(seeds), -1, -1), Draws(torch.tensor(seeds)), "view")


def test_rotations_are_rotations_and_uniform():
    points = torch.eye(3)
    R = views(CloudAugmentation(0.0, 0.0, least_kept=1.0, turned=1.0), points, *range(2000))
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
    assert R.mean(0).abs().max() < 0.05
    assert R.square().mean(0).sub(1 / 3).abs().max() < 0.03


def test_views_are_rotated_as_configured():
    points = object_cloud(two_triangles(), 500)
    still = CloudAugmentation(stretch=0.0, jitter_m=0.0, least_kept=0.6, turned=0.0)
    (view,) = views(still, points, 3)
    assert 300 <= len(view.unique(dim=0)) <= 500
    assert set(view[:, 2].unique().tolist()) <= {0.0, 5.0}, "about the vertical"
    assert not torch.allclose(view.amax(0), points.amax(0))
    torch.testing.assert_close(view.norm(dim=-1).amax(), points.norm(dim=-1).amax(), atol=0.2, rtol=0)
    assert torch.equal(view, views(still, points, 1, 3)[1])
    assert len(views(CloudAugmentation(turned=1.0), points, 3)[0, :, 2].unique()) > 100


def test_a_datamodule_keeps_its_objects_in_a_file(tmp_path):
    settings = {"root": str(tmp_path), "generate": generate_clouds, "classes": CLASSES, "points": 64}
    settings["per_class"] = {"train": 3, "val": 2}
    data = WindowsModule(partial(ObjectClouds, **settings), Loading(4, 2))
    data.setup("fit")
    batches = list(data.train_dataloader())
    assert len(batches) == 2
    assert batches[0].points.shape == (4, 2, 64, 3)
    assert batches[0].label.shape == (4,)
    first = next(iter(data.val_dataloader()))
    first_cloud = data.dataset("val").clouds[0]
    assert torch.equal(first.points[0, 0], first_cloud), "as it is"
    assert not torch.equal(first.points[0, 0], first.points[0, 1])
    made = (tmp_path / "train.safetensors").stat().st_mtime_ns
    ObjectClouds([], "train", **settings)
    assert (tmp_path / "train.safetensors").stat().st_mtime_ns == made
    assert len(ObjectClouds([], "train", **settings | {"per_class": {"train": 4}})) == 16
    with pytest.raises(WearcapError, match="'chair'"):
        ObjectClouds([], "train", **settings | {"classes": ["chairr"]})
