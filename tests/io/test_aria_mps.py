import gzip
import lzma

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.io.devices.aria_mps import (
    R_CPF_DEVICE,
    head_stream,
    nominal_T_aria_cpf,
    read_closed_loop,
    read_mps,
    read_mps_points,
    read_points,
)
from wearcap.io.devices.axes import WORLDS
from wearcap.io.formats import csv_table

HEADER = (
    "graph_uid,tracking_timestamp_us,utc_timestamp_ns,tx_world_device,ty_world_device,tz_world_device,"
    "qx_world_device,qy_world_device,qz_world_device,qw_world_device,device_linear_velocity_x_device,"
    "device_linear_velocity_y_device,device_linear_velocity_z_device,angular_velocity_x_device,"
    "angular_velocity_y_device,angular_velocity_z_device,gravity_x_world,gravity_y_world,gravity_z_world,quality_score"
)


def rows(n=50, **changes):
    """CSV rows of a wearer who walks along +x at 1 m/s, head level, 100 Hz."""
    T_world_aria = (nominal_T_aria_cpf() @ Rigid(R_CPF_DEVICE, torch.zeros(3))).inverse()
    w, x, y, z = rotation.quat_wxyz_from_matrix(T_world_aria.R).tolist()
    table = []
    for i in range(n):
        row = dict(
            zip(
                HEADER.split(","),
                ["g", 10_000_000 + 10_000 * i, -1, 0.01 * i, 0, 1.6, x, y, z, w, 0, 0, 0, 0, 0, 0, 0, 0, -9.81, 1.0],
            )
        )
        row |= {key: value(i) if callable(value) else value for key, value in changes.items()}
        table.append(row)
    return table


def write(path, table, opener=open):
    with opener(path, "wt") as file:
        file.write(",".join(table[0]) + "\n")
        file.writelines(",".join(str(v) for v in row.values()) + "\n" for row in table)
    return path


def test_level_head_faces_along_its_walk(tmp_path):
    head = head_stream(read_closed_loop(write(tmp_path / "t.csv", rows()))[0], fps=60.0)
    assert head.R_world_device == pytest.approx(torch.eye(3).expand(len(head.timestamps), 3, 3), abs=1e-5)
    assert head.timestamps.diff() == pytest.approx(torch.full((len(head.timestamps) - 1,), 1 / 60, dtype=torch.float64))
    assert head.timestamps[0].item() == 10.0
    speed = (head.t_world_device[-1] - head.t_world_device[0]) / (head.timestamps[-1] - head.timestamps[0])
    assert speed.tolist() == pytest.approx([1.0, 0.0, 0.0], abs=1e-4)


@pytest.mark.parametrize(("suffix", "opener"), [("", open), (".gz", gzip.open), (".xz", lzma.open)])
def test_compression_changes_nothing(tmp_path, suffix, opener):
    plain = read_closed_loop(write(tmp_path / "plain.csv", rows()))
    packed = read_closed_loop(write(tmp_path / f"packed.csv{suffix}", rows(), opener))
    assert torch.equal(plain[0].t_world_body, packed[0].t_world_body)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tx_world_device": "nan"}, "row 1: pose is NaN"),
        ({"quality_score": "inf"}, "quality_score is NaN or infinite"),
        ({"tracking_timestamp_us": lambda i: 1000 * (20 - i)}, "timestamps that rise"),
        ({"tracking_timestamp_us": 7}, "timestamps that rise"),
        ({"qw_world_device": 3.0}, "unit quaternions"),
        ({"gravity_z_world": 9.81}, "gravity points along"),
        ({"gravity_x_world": -9.81, "gravity_z_world": 0}, "gravity points along"),
        ({"gravity_z_world": -981}, "m/s² long"),
        ({"graph_uid": lambda i: f"g{i // 30}"}, "2 unconnected world frames"),
        ({"ty_world_device": "left"}, "not a table of numbers"),
    ],
)
def test_defects_are_named(tmp_path, changes, message):
    path = write(tmp_path / "t.csv", rows(**changes))
    with pytest.raises(WearcapError, match=message.replace("+", r"\+")) as error:
        read_closed_loop(path)
    assert str(path) in str(error.value)


def test_missing_column_names_the_nearest(tmp_path):
    table = [{("tz_world_devcie" if k == "tz_world_device" else k): v for k, v in row.items()} for row in rows()]
    with pytest.raises(WearcapError, match=r"no column 'tz_world_device'.*'tz_world_devcie'"):
        read_closed_loop(write(tmp_path / "t.csv", table))


def test_hostile_files(tmp_path):
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "header.csv").write_text(HEADER + "\n")
    (tmp_path / "binary.csv").write_bytes(bytes(range(128, 256)) * 40)
    whole = write(tmp_path / "whole.csv.gz", rows(2000), gzip.open).read_bytes()
    (tmp_path / "cut.csv.gz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "false.csv.xz").write_bytes(b"no xz at all")
    expected = {
        "empty.csv": "empty",
        "header.csv": "no rows",
        "binary.csv": "not a text file",
        "cut.csv.gz": "cut short",
        "false.csv.xz": "damaged",
        "absent.csv": "no such file",
    }
    for name, message in expected.items():
        with pytest.raises(WearcapError, match=message):
            read_closed_loop(tmp_path / name)


def test_two_poses_a_century_apart_are_not_resampled(tmp_path):
    table = [row | {"tracking_timestamp_us": k * 3 * 10**15} for k, row in enumerate(rows(2))]
    write(tmp_path / "closed_loop_trajectory.csv", table)
    with pytest.raises(WearcapError, match=r"trajectory\.csv: poses over 8.33e\+05 hours"):
        read_mps(tmp_path)
    assert len(read_mps(tmp_path, fps=None).head.timestamps) == 2


def test_y_up_world_is_turned(tmp_path):
    table = rows(gravity_y_world=-9.81, gravity_z_world=0, ty_world_device=1.6, tz_world_device=0.25)
    read = read_closed_loop(write(tmp_path / "t.csv", table))
    assert read.up == "y"
    assert read[0].t_world_body[0].tolist() == pytest.approx([0.0, -0.25, 1.6], abs=1e-6)
    assert torch.linalg.det(WORLDS["y"]) == pytest.approx(1.0)


def test_points_are_kept_by_their_certainty(tmp_path):
    header = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std\n"
    lines = ["1,g,1,2,3,0.001,0.002", "2,g,4,5,6,0.006,0.002", "3,g,7,8,9,0.001,0.02", "4,g,0,1,2,0.004,0.009"]
    (tmp_path / "p.csv").write_text(header + "\n".join(lines) + "\n")
    cloud = read_points(tmp_path / "p.csv")
    assert cloud.points_world.tolist() == [[1, 2, 3], [0, 1, 2]]
    assert cloud.confidence is not None
    assert cloud.confidence.tolist() == pytest.approx([0.8, 0.2], abs=1e-6)


POINTS = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std\n"
SEEN = "uid,frame_tracking_timestamp_us,camera_serial,u,v\n"


def test_points_know_when_they_were_first_seen(tmp_path, monkeypatch):
    """Rows in any order, more than one piece of the file, ids beyond 2^53; the unsure and the unseen are left out."""
    big = 2**60 + 1
    (tmp_path / "semidense_points.csv").write_text(
        POINTS + f"9,g,1,0,0,0.001,0.001\n{big},g,2,0,0,0.001,0.001\n4,g,3,0,0,0.1,0.001\n7,g,4,0,0,0.001,0.001\n"
    )
    rows = [(big, 30), (9, 50), (4, 10), (big + 1, 1), (9, 20), (big, 40), (123, 5)]
    with gzip.open(tmp_path / "semidense_observations.csv.gz", "wt") as file:
        file.write(SEEN + "".join(f"{uid},{time}000000,0072510f,1.5,2.5\n" for uid, time in rows))
    monkeypatch.setattr(csv_table.iter_columns, "__kwdefaults__", {"text": (), "whole": (), "rows": 3})
    cloud = read_mps_points(tmp_path)
    assert cloud is not None
    assert cloud.first_seen is not None
    assert cloud.points_world[:, 0].tolist() == [1, 2]
    assert cloud.first_seen.tolist() == [20.0, 30.0]


def test_observations_of_another_recording_and_damaged_ones_are_named(tmp_path):
    points, seen = tmp_path / "p.csv", tmp_path / "seen.csv"
    points.write_text(POINTS + "9,g,1,0,0,0.001,0.001\n")
    for rows, message in (
        ("8,1,c,1,1\n", "names none of the points"),
        ("", "no rows"),
        ("9,x,c,1,1\n", "not a table of numbers"),
        ("9,1.5,c,1,1\n", "not a table of numbers"),
        ("9\n", "not a table of numbers"),
    ):
        seen.write_text(SEEN + rows)
        with pytest.raises(WearcapError, match=message) as error:
            read_points(points, observations=seen)
        assert str(seen) in str(error.value)


def test_folder_without_trajectory(tmp_path):
    with pytest.raises(WearcapError, match=r"no closed_loop_trajectory\.csv"):
        read_mps(tmp_path)


def test_subfolder_slam_is_found(tmp_path):
    (tmp_path / "slam").mkdir()
    write(tmp_path / "slam" / "closed_loop_trajectory.csv", rows())
    recording = read_mps(tmp_path, fps=30.0)
    assert recording.head is not None
    assert len(recording.head.timestamps) == 15
    assert recording.points is None


@pytest.mark.real
def test_real_recording_has_an_upright_head(real_data):
    recording = read_mps(real_data / "aria_mps")
    assert recording.head is not None
    assert recording.points is not None
    R, t = recording.head.R_world_device, recording.head.t_world_device
    assert R[:, 2, 2].mean() > 0.95, "the head's z axis points up"
    assert R[:, 2, 0].abs().mean() < 0.2, "its x axis is roughly level"
    assert len(recording.head.timestamps) == 684, "11.38 s at 60 Hz"
    assert t.diff(dim=0).norm(dim=-1).sum() == pytest.approx(7.67, abs=0.3), "MPS's own summary: 7.67 m"
    assert len(recording.points.points_world) == 27231


@pytest.mark.real
def test_velocity_column_agrees_with_the_poses(real_data):
    """The file's velocity is in device axes: turned to the world it is the path's derivative."""
    path = real_data / "aria_mps" / "closed_loop_trajectory.csv.xz"
    track, _, _ = read_closed_loop(path)
    columns = [f"device_linear_velocity_{axis}_device" for axis in "xyz"]
    vel_device = torch.stack([torch.from_numpy(column) for column in csv_table.read_columns(path, columns).values()], 1)
    vel_world = (track.R_world_body @ vel_device.float()[..., None])[..., 0]
    step = 20
    moved = (track.t_world_body[step:] - track.t_world_body[:-step]).double()
    vel_path = moved / (track.timestamps[step:] - track.timestamps[:-step])[:, None]
    assert (vel_path - vel_world[step // 2 : -step // 2]).norm(dim=-1).median() < 0.02


@pytest.mark.real
def test_nominal_head_axes_fit_a_calibrated_device(real_data):
    """Real extrinsics: left and right SLAM cameras must look forward and to their own side of the head."""
    import json

    cameras = json.loads((real_data / "aria_adt_sample" / "extracted" / "meta.json").read_text())["cameras"]
    R_device_aria = R_CPF_DEVICE.T @ nominal_T_aria_cpf().R.T
    axis = {
        side: R_device_aria @ torch.tensor(np.array(cameras[f"camera-slam-{side}"]["T_device_camera"])[:3, 2]).float()
        for side in ("left", "right")
    }
    assert axis["left"] == pytest.approx(axis["right"] * torch.tensor([1.0, -1.0, 1.0]), abs=0.03)
    assert axis["left"][0] > 0.75
    assert axis["left"][1] > 0.55


@pytest.mark.real
def test_real_head_looks_where_it_goes_at_first(real_data):
    """Before the wearer walks round the table looking at it, the walk's first two seconds are straight ahead."""
    head = read_mps(real_data / "aria_mps").head
    assert head is not None
    velocity = (head.t_world_device[150] - head.t_world_device[30])[:2]
    forward = head.R_world_device[30:150, :2, 0].mean(0)
    cos = torch.nn.functional.cosine_similarity(velocity, forward, dim=0)
    assert cos > 0.9


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_damaged_files_are_read_or_refused(tmp_path_factory, data):
    """Any bytes may be changed, dropped or doubled, before or after compression."""
    folder = tmp_path_factory.mktemp("fuzz")
    packed = data.draw(st.booleans())
    path = write(folder / ("t.csv.gz" if packed else "t.csv"), rows(12), gzip.open if packed else open)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content) - 1))
        content[start : start + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    path.write_bytes(bytes(content))
    try:
        read = read_closed_loop(path)
        assert read[0].t_world_body.isfinite().all()
        head_stream(read[0], fps=None)
    except WearcapError:
        pass
