"""Which object is nearest: the fast search against a plain one, at current poses, by class and reach."""

import math

import numpy as np
import pytest
import torch

from boxes import box_mesh
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.geometry.rigid import Rigid
from wearcap.scene.objects import Environment, Freedom, SceneObject

WHITE = np.ones(3, np.float32)


def box(size) -> Mesh:
    """Standing on its frame's floor."""
    x, y, z = size
    return box_mesh((-x / 2, -y / 2, 0.0), (x / 2, y / 2, z))


def scene_object(name, mesh, x=0.0, y=0.0, turn=0.0, freedom=Freedom("plane")) -> SceneObject:
    R = rotation.about_axis("z", torch.tensor(float(turn)))
    return SceneObject(name, "box", mesh, R, torch.tensor([x, y, 0.0]), freedom)


def random_mesh(rng, faces) -> Mesh:
    start = rng.uniform(-0.5, 0.5, (faces, 1, 3))
    corners = (start + rng.normal(0, 0.1, (faces, 3, 3))).reshape(-1, 3)
    return Mesh(corners.astype(np.float32), np.arange(3 * faces, dtype=np.int32).reshape(-1, 3), np.ones(3, np.float32))


def cloud(rng, points) -> Mesh:
    return Mesh(rng.normal(0, 0.3, (points, 3)).astype(np.float32), np.zeros((0, 3), np.int32), WHITE)


def random_environment(rng, count=25) -> Environment:
    shared = random_mesh(rng, 30)
    objects = []
    for k in range(count):
        mesh = cloud(rng, 50) if k % 5 == 0 else shared if k % 3 == 0 else random_mesh(rng, 20)
        hinged = Freedom("hinge", pivot=(0.0, 0.0, 0.0))
        R = rotation.exp(torch.tensor(rng.normal(0, 1, 3), dtype=torch.float32))
        t = torch.tensor(rng.uniform(-3, 3, 3), dtype=torch.float32)
        objects.append(SceneObject(f"thing_{k}", "box", mesh, R, t, hinged if k % 2 else Freedom("free")))
    return Environment(tuple(objects))


def plain_closest(point, mesh, T):
    """Closest point of one object by trying every triangle's plane, sides and corners (or every point of a cloud)."""
    vertices = (T.to(torch.float64) @ torch.from_numpy(mesh.vertices).double()).numpy()
    candidates = list(vertices)
    for a, b, c in vertices[mesh.faces]:
        for start, stop in ((a, b), (b, c), (c, a)):
            share = np.clip(np.dot(point - start, stop - start) / max(np.dot(stop - start, stop - start), 1e-30), 0, 1)
            candidates.append(start + share * (stop - start))
        st, *_ = np.linalg.lstsq(np.stack([b - a, c - a], 1), point - a, rcond=None)
        if st.min() >= 0 and st.sum() <= 1:
            candidates.append(a + st[0] * (b - a) + st[1] * (c - a))
    distance = np.linalg.norm(np.array(candidates) - point, axis=1)
    return distance.min(), candidates[int(distance.argmin())]


@pytest.mark.parametrize("contact_class", [None, "hinged", "sliding"])
def test_fast_and_plain_search_agree(contact_class):
    rng = np.random.default_rng(0)
    environment = random_environment(rng)
    moved = {
        f"thing_{k}": Rigid(
            rotation.exp(torch.tensor(rng.normal(0, 1, 3), dtype=torch.float32)),
            torch.tensor(rng.uniform(-3, 3, 3), dtype=torch.float32),
        )
        for k in range(0, 25, 4)
    }
    points = torch.tensor(rng.uniform(-4, 4, (40, 3)), dtype=torch.float32)
    found = environment.nearest(points, moved, contact_class, reach_m=1.0)
    assert (found.object_index >= 0).any()
    assert (found.object_index < 0).any()
    for q, point in enumerate(points.double().numpy()):
        answers = {
            k: plain_closest(point, item.mesh, moved.get(item.name, item.T_world_object))
            for k, item in enumerate(environment.objects)
            if contact_class in (None, item.freedom.contact_class)
        }
        best = min(answers, key=lambda k: answers[k][0])
        if answers[best][0] >= 1.0:
            assert found.object_index[q] == -1
            assert found.distance[q] == math.inf
        else:
            assert found.object_index[q] == best
            assert found.distance[q].item() == pytest.approx(answers[best][0], abs=1e-6)


def test_distance_over_time_agrees_with_nearest_frame_by_frame():
    rng = np.random.default_rng(1)
    mesh = random_mesh(rng, 60)
    environment = Environment((scene_object("a", mesh), scene_object("b", cloud(rng, 40), x=1.0)))
    frames = 30
    T = Rigid(rotation.exp(torch.tensor(rng.normal(0, 1, (frames, 3)))), torch.tensor(rng.normal(0, 0.5, (frames, 3))))
    points = torch.tensor(rng.normal(0, 0.5, (frames, 3)))
    for name in ("a", "b"):
        alone = Environment((environment.by_name(name),))
        distance, closest = environment.distance(name, points, T)
        for k in range(frames):
            one = alone.nearest(points[k : k + 1], {name: T[k]})
            assert distance[k].item() == pytest.approx(one.distance.item(), abs=1e-9)
            _, plain = plain_closest(points[k].numpy(), environment.by_name(name).mesh, T[k])
            np.testing.assert_allclose(closest[k].numpy(), plain, atol=1e-6)
    resting, _ = environment.distance("a", points, environment.by_name("a").T_world_object)
    at_rest = Environment((environment.by_name("a"),)).nearest(points)
    torch.testing.assert_close(resting, at_rest.distance)


def test_distances_of_a_box():
    environment = Environment((scene_object("chest", box((2.0, 1.0, 0.5)), x=3.0, turn=math.pi / 2),))
    points = torch.tensor([[3.0, 0.0, 0.9], [3.9, 0.0, 0.25], [3.0, 1.3, 0.1], [3.0, 0.0, 0.45]])
    found = environment.nearest(points)
    torch.testing.assert_close(found.distance, torch.tensor([0.4, 0.4, 0.3, 0.05]))
    _, closest = environment.distance("chest", points[1:2], environment.objects[0].T_world_object)
    torch.testing.assert_close(closest[0], torch.tensor([3.5, 0.0, 0.25]), atol=1e-6, rtol=0)


def test_a_moved_object_is_found_where_it_is_and_others_where_they_began():
    environment = Environment(
        (scene_object("near", box((1.0, 1.0, 1.0))), scene_object("far", box((1.0, 1.0, 1.0)), x=5.0))
    )
    hand = torch.tensor([[0.0, 0.7, 0.5]])
    assert environment.nearest(hand).object_index.tolist() == [0]
    swapped = {"near": Rigid(torch.eye(3), torch.tensor([5.0, 0, 0])), "far": Rigid(torch.eye(3), torch.zeros(3))}
    assert environment.nearest(hand, swapped).object_index.tolist() == [1]
    gone = environment.nearest(hand, {"near": Rigid(torch.eye(3), torch.tensor([0.0, 9.0, 0.0]))}, reach_m=0.5)
    assert gone.object_index.tolist() == [-1]


def test_points_that_are_not_numbers_touch_nothing():
    environment = Environment((scene_object("chest", box((1.0, 1.0, 1.0))),))
    points = torch.tensor([[0.0, 0.7, 0.5], [math.nan, 0.0, 0.0], [0.0, 0.8, 0.5]])
    found = environment.nearest(points)
    assert found.object_index.tolist() == [0, -1, 0]
    distance, closest = environment.distance("chest", points, environment.objects[0].T_world_object)
    assert distance.isnan().tolist() == [False, True, False]
    assert closest[1].isnan().all()
    assert distance[2].item() == pytest.approx(0.3, abs=1e-6)


def test_nothing_to_find():
    hand = torch.zeros(2, 3)
    assert Environment(()).nearest(hand).object_index.tolist() == [-1, -1]
    only_sliding = Environment((scene_object("chest", box((1.0, 1.0, 1.0))),))
    found = only_sliding.nearest(hand, contact_class="hinged")
    assert found.object_index.tolist() == [-1, -1]
    assert found.distance.isinf().all()
    assert only_sliding.nearest(torch.zeros(0, 3)).distance.shape == (0,)


def test_names_are_checked():
    chest = scene_object("chest", box((1.0, 1.0, 1.0)))
    with pytest.raises(WearcapError, match="several objects are named 'chest'"):
        Environment((chest, chest))
    environment = Environment((chest,))
    with pytest.raises(WearcapError, match="no object 'sofa'.*chest"):
        environment.nearest(torch.zeros(1, 3), {"sofa": chest.T_world_object})
    with pytest.raises(WearcapError, match="no object 'sofa'"):
        environment.distance("sofa", torch.zeros(1, 3), chest.T_world_object)
    with pytest.raises(WearcapError, match="no contact class 'carried'"):
        environment.nearest(torch.zeros(1, 3), contact_class="carried")
