"""Environments as files: round trips, what a person may write by hand, and what cannot be true."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given

from hostile import fuzz, mutated
from wearcap.boundary.limits import LIMITS, Limits
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.mesh import Mesh
from wearcap.io.formats.environment import read_environment, write_environment
from wearcap.io.formats.ply import Ply, read_ply, write_ply
from wearcap.scene.objects import Environment, Freedom, SceneObject

TETRA = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)
GREY = np.full(3, 0.6, np.float32)


def scene_object(name="sofa", freedom=Freedom("plane"), mesh=None, turn=0.3, t=(1.1, -2.7, 0.0)) -> SceneObject:
    R = rotation.about_axis("z", torch.tensor(turn))
    return SceneObject(name, "seat", mesh or Mesh(TETRA, FACES, GREY), R, torch.tensor(t), freedom)


def every_kind() -> Environment:
    door = Freedom("hinge", pivot=(1.1, -2.7, 0.0), limits=(-math.pi / 2, math.radians(100)))
    drawer = Freedom("axis", axis=(0.0, -1.0, 0.0), limits=(0.0, 0.45))
    cloud = Mesh(TETRA, np.zeros((0, 3), np.int32), np.eye(4, 3, dtype=np.float32))
    per_face = Mesh(np.append(TETRA, [[1, 1, 1]], 0).astype(np.float32), FACES, np.eye(4, 3, dtype=np.float32))
    return Environment(
        (
            scene_object(),
            scene_object("door", door),
            scene_object("drawer", drawer, turn=2.0),
            scene_object("box", Freedom("free"), cloud),
            scene_object("chair", Freedom("hinge", pivot=(1.0, -2.0, 0.0)), per_face),
        )
    )


def test_points_of_all_objects_together_have_a_limit(tmp_path, monkeypatch):
    """A mesh is read once, but whatever moves or shows objects takes the points of each."""
    write_environment(Environment((scene_object(),)), tmp_path)
    content = json.loads((tmp_path / "environment.json").read_text())
    content["objects"] = [content["objects"][0] | {"name": f"sofa {k}"} for k in range(100)]
    (tmp_path / "environment.json").write_text(json.dumps(content))
    assert len(read_environment(tmp_path)) == 100
    monkeypatch.setitem(LIMITS, "mesh", Limits(bytes=99 * TETRA.nbytes))
    with pytest.raises(WearcapError, match=r"environment.json: larger than"):
        read_environment(tmp_path)


def test_every_kind_survives_a_round_trip(tmp_path):
    before = every_kind()
    write_environment(before, tmp_path)
    after = read_environment(tmp_path)
    assert [item.name for item in after.objects] == ["sofa", "door", "drawer", "box", "chair"]
    for old, new in zip(before.objects, after.objects):
        assert (old.name, old.category, old.freedom.kind) == (new.name, new.category, new.freedom.kind)
        assert (old.freedom.pivot, old.freedom.axis) == (new.freedom.pivot, new.freedom.axis)
        torch.testing.assert_close(old.R_world_object, new.R_world_object, atol=1e-6, rtol=0)
        assert torch.equal(old.t_world_object, new.t_world_object)
        if old.freedom.limits is not None:
            assert new.freedom.limits == pytest.approx(old.freedom.limits, abs=1e-12)
    for name in ("sofa", "door", "box"):
        np.testing.assert_array_equal(after.by_name(name).mesh.vertices, TETRA)
    np.testing.assert_array_equal(after.by_name("sofa").mesh.faces, FACES)
    assert not len(after.by_name("box").mesh.faces)
    np.testing.assert_allclose(after.by_name("box").mesh.color, np.eye(4, 3), atol=1 / 255)
    chair = after.by_name("chair").mesh
    np.testing.assert_array_equal(chair.vertices[chair.faces], TETRA[FACES])
    np.testing.assert_allclose(chair.color[chair.faces[:, 0]], np.eye(4, 3), atol=1 / 255)


def test_a_second_round_trip_changes_nothing(tmp_path):
    write_environment(every_kind(), tmp_path / "a")
    write_environment(read_environment(tmp_path / "a"), tmp_path / "b" / "environment.json")
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 6
    first, second = (read_environment(tmp_path / each) for each in "ab")
    for old, new in zip(first.objects, second.objects):
        np.testing.assert_array_equal(old.mesh.vertices, new.mesh.vertices)
        torch.testing.assert_close(old.R_world_object, new.R_world_object, atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    "names", [("../../evil", "/etc/passwd"), ("a/b", "a_b", "A_B"), ("Tür 1", "T r 1"), ("CON", "...")]
)
def test_any_name_becomes_a_safe_file_name(tmp_path, names):
    write_environment(Environment(tuple(scene_object(name) for name in names)), tmp_path / "flat")
    rows = json.loads((tmp_path / "flat" / "environment.json").read_text())["objects"]
    files = [row["mesh"] for row in rows]
    assert len({file.lower() for file in files}) == len(names)
    assert all(file.startswith("objects/") and file.isascii() and ".." not in file for file in files)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flat"]
    assert [item.name for item in read_environment(tmp_path / "flat").objects] == list(names)


def plain_file(tmp_path) -> dict:
    (tmp_path / "objects").mkdir(exist_ok=True)
    write_ply(Ply(TETRA, faces=FACES), tmp_path / "objects" / "door.ply")
    row = {
        "name": "door",
        "category": "door",
        "mesh": "objects/door.ply",
        "R_world_object": np.eye(3).tolist(),
        "t_world_object": [4, 0, 0],
        "freedom": {"kind": "hinge", "pivot": [4, 0, 0], "limits_deg": [0, 90]},
    }
    return {"schema_version": 1, "objects": [row]}


def read(content, tmp_path):
    path = tmp_path / "environment.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_environment(path)


def test_a_file_written_by_hand(tmp_path):
    door = read(plain_file(tmp_path), tmp_path).by_name("door")
    assert door.freedom == Freedom("hinge", (4.0, 0.0, 0.0), None, (0.0, math.pi / 2))
    np.testing.assert_array_equal(door.mesh.color, np.full(3, 0.7, np.float32))
    content = plain_file(tmp_path)
    content["objects"][0]["R_world_object"] = [[0.7071, -0.7071, 0], [0.7071, 0.7071, 0], [0, 0, 1]]
    R = read(content, tmp_path).by_name("door").R_world_object.double()
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
    assert len(read({"schema_version": 1, "objects": []}, tmp_path)) == 0


def changed(**changes):
    return lambda row: row.update(changes)


def freed(**changes):
    return lambda row: row["freedom"].update(changes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row.pop("freedom"), "object 'door': no degree of freedom.*plane, axis, hinge, free"),
        (changed(freedom=None), "no degree of freedom"),
        (changed(freedom={}), "no degree of freedom None"),
        (freed(kind="swing"), "no degree of freedom 'swing'"),
        (freed(pivot=[6, 0, 0]), "hinge is 1.00 m from its mesh"),
        (freed(pivot=[0.004, 0, 0]), "hinge is 4.00 m"),
        (freed(pivot=[4, 0]), "pivot is"),
        (freed(pivot=[4, 0, math.nan]), "pivot is.*finite"),
        (freed(limits_deg=[90, 0]), "are reversed"),
        (freed(limits_deg=[10, 90]), "0 is the initial pose"),
        (freed(limits_m=[0, 1]), "unknown key 'limits_m'"),
        (freed(axis=[1, 0, 0]), "unknown key 'axis'"),
        (lambda row: row["freedom"].pop("pivot"), "no 'pivot'"),
        (changed(freedom={"kind": "axis", "axis": [1, 1, 0]}), "unit vector"),
        (changed(mesh="objects/sofa.ply"), "its mesh objects/sofa.ply is missing"),
        (changed(mesh="../door.ply"), "it names the file"),
        (changed(mesh="/tmp/door.ply"), "it names the file"),
        (changed(mesh=3), "it names the file"),
        (changed(R_world_object=(2 * np.eye(3)).tolist()), "no rotation"),
        (changed(R_world_object=np.diag([1, 1, -1]).tolist()), "no rotation"),
        (changed(R_world_object=[[1, 0, 0]]), "R_world_object is"),
        (changed(t_world_object=[math.inf, 0, 0]), "t_world_object is"),
        (changed(t_world_object=[1e39, 0, 0]), "t_world_object is"),
        (changed(t_world_object=[True, 0, 0]), "t_world_object is"),
        (changed(t_world_object=["1", 0, 0]), "t_world_object is"),
        (changed(t_world_object="123"), "t_world_object is"),
        (changed(weight=3), "unknown key 'weight'"),
        (changed(category=3), "category 3"),
        (lambda row: row.pop("t_world_object"), "no 't_world_object'"),
        (changed(name=" "), "without a name"),
        (lambda row: row.pop("name"), "object 0: an object without a name"),
    ],
)
def test_what_cannot_be_true_is_refused(tmp_path, change, message):
    content = plain_file(tmp_path)
    change(content["objects"][0])
    with pytest.raises(WearcapError, match=message) as raised:
        read(content, tmp_path)
    assert str(raised.value).startswith(str(tmp_path / "environment.json"))


def test_the_whole_file_is_checked(tmp_path):
    content = plain_file(tmp_path)
    with pytest.raises(WearcapError, match="several objects are named 'door'"):
        read(content | {"objects": content["objects"] * 2}, tmp_path)
    with pytest.raises(WearcapError, match="schema version 2"):
        read(content | {"schema_version": 2}, tmp_path)
    with pytest.raises(WearcapError, match="unknown key 'units'"):
        read(content | {"units": "cm"}, tmp_path)
    for wrong in ([], {"objects": {}}, {"schema_version": 1}, 3, None):
        with pytest.raises(WearcapError, match="not an environment"):
            read(wrong, tmp_path)
    with pytest.raises(WearcapError, match="JSON"):
        read(json.dumps(content)[:-9], tmp_path)
    with pytest.raises(WearcapError, match="no such file"):
        read_environment(tmp_path / "elsewhere")
    write_ply(Ply(TETRA[:0]), tmp_path / "objects" / "door.ply")
    with pytest.raises(WearcapError, match="empty mesh"):
        read(content, tmp_path)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (scene_object(freedom=Freedom("hinge", pivot=(9.0, 9.0, 0.0))), "hinge is"),
        (scene_object(freedom=Freedom("plane", limits=(0.0, 1.0))), "limits of an object"),
        (scene_object(t=(math.nan, 0.0, 0.0)), "not finite"),
        (scene_object(freedom=Freedom("hinge", pivot=(math.nan, 0.0, 0.0))), "not finite"),
        (scene_object(mesh=Mesh(TETRA[:0], FACES[:0], GREY)), "no points"),
        (scene_object(name=""), "no name"),
    ],
)
def test_the_writer_refuses_what_the_reader_would_and_leaves_the_old_file(tmp_path, item, message):
    write_environment(every_kind(), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    with pytest.raises(WearcapError, match=message):
        write_environment(Environment((scene_object("first"), item)), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("environment")
    plain_file(path)
    return path


@fuzz
@given(
    text=mutated(
        json.dumps(
            {
                "schema_version": 1,
                "objects": [
                    {
                        "name": "door",
                        "category": "door",
                        "mesh": "objects/door.ply",
                        "R_world_object": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                        "t_world_object": [4, 0, 0],
                        "freedom": {"kind": "hinge", "pivot": [4, 0, 0], "limits_deg": [0, 90]},
                    }
                ],
            }
        )
    )
)
def test_damaged_files_are_read_or_refused(folder, text):
    (folder / "environment.json").write_text(text, encoding="utf-8")
    try:
        environment = read_environment(folder)
    except WearcapError:
        return
    assert all(item.t_world_object.isfinite().all() for item in environment.objects)


MOVABLE = ("Chair", "Sofa", "KitchenTable", "CoffeeTable", "Trash", "NightStand", "ReadingDesk", "Ball", "ShoeRack")


def furnished(folder) -> Environment:
    """The small house: furniture where its layout has it, and a door that turns about its left edge."""
    layout = json.loads((folder / "small_house_layout.json").read_text())
    meshes = {}
    for row in layout:
        file = folder / "meshes" / f"{row['model']}_visual.ply"
        if row["model"] not in meshes and file.is_file() and row["model"].startswith((*MOVABLE, "Door")):
            ply = read_ply(file)
            meshes[row["model"]] = Mesh(ply.points, ply.faces, GREY)
    objects = []
    for row in (row for row in layout if row["model"] in meshes):
        *xyz, roll, pitch, yaw = row["pose_xyz_rpy"]
        R = (
            rotation.about_axis("z", torch.tensor(yaw))
            @ rotation.about_axis("y", torch.tensor(pitch))
            @ rotation.about_axis("x", torch.tensor(roll))
        )
        t, mesh, freedom = torch.tensor(xyz), meshes[row["model"]], Freedom("plane")
        if row["model"].startswith("Door"):
            edge = R @ torch.tensor([float(mesh.vertices[:, 0].min()), 0.0, 0.0]) + t
            freedom = Freedom("hinge", pivot=tuple(edge.tolist()), limits=(0.0, math.pi / 2))
        objects.append(SceneObject(row["name"], row["model"].split("_")[0].lower(), mesh, R, t, freedom))
    return Environment(tuple(objects))


@pytest.mark.real
def test_a_furnished_house(real_data, tmp_path):
    house = furnished(real_data / "furniture_meshes")
    assert len(house) == 20
    write_environment(house, tmp_path)
    read = read_environment(tmp_path)
    assert [item.name for item in read.objects] == [item.name for item in house.objects]
    rng = np.random.default_rng(0)
    points = torch.tensor(np.c_[rng.uniform(-9, 9, (3000, 2)), rng.uniform(0, 2, 3000)]).float()
    here, back = house.nearest(points, reach_m=0.5), read.nearest(points, reach_m=0.5)
    same = here.object_index == back.object_index
    assert same.float().mean() > 0.999, "but for ties"
    torch.testing.assert_close(here.distance[same], back.distance[same], atol=1e-5, rtol=0)
    alone = torch.stack([house.distance(item.name, points, item.T_world_object)[0] for item in house.objects], 1)
    nearest = alone.amin(1)
    assert ((here.object_index >= 0) == (nearest < 0.5)).all()
    reached = here.object_index >= 0
    torch.testing.assert_close(here.distance[reached], nearest[reached], atol=1e-6, rtol=0)


@pytest.mark.real
def test_a_doors_handle_is_found_where_the_door_has_turned_to(real_data):
    house = furnished(real_data / "furniture_meshes")
    door = next(item for item in house.objects if item.freedom.kind == "hinge")
    far_edge = door.mesh.vertices[door.mesh.vertices[:, 0].argmax()].copy()
    far_edge[2] = 1.0
    opened = door.freedom.moved(door.T_world_object, torch.tensor(math.pi / 2))
    hand = (opened.R @ torch.from_numpy(far_edge) + opened.t)[None]
    closed = house.nearest(hand, contact_class="hinged", reach_m=0.3)
    turned = house.nearest(hand, {door.name: opened}, "hinged", 0.3)
    assert closed.object_index.item() == -1
    assert turned.object_index.item() == house.index(door.name)
    assert turned.distance.item() < 0.15
