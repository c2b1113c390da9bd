"""The one reader of trajectories: every format by its content, units of time, and what is refused."""

import gzip
import lzma
import tracemalloc

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import short_walk
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.poses import write_tum
from wearcap.io.formats.trajectory import read_trajectory, read_trajectory_file, trajectory_format

WRITERS = {
    "TUM": ("walk.txt", short_walk.tum),
    "EuRoC": ("data.csv", short_walk.euroc),
    "COLMAP": ("images.txt", short_walk.colmap_text),
    "COLMAP, binary": ("images.bin", short_walk.colmap_binary),
    "hloc": ("results.txt", short_walk.hloc),
    "DROID-SLAM": ("walk/poses.npy", short_walk.droid),
    "DROID-SLAM, archive": ("walk.npz", short_walk.droid_archive),
    "MPS": ("closed_loop_trajectory.csv", short_walk.mps),
    "KITTI": ("00.txt", short_walk.kitti),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_the_walk_comes_back_from_every_format(tmp_path, kind):
    name, write = WRITERS[kind]
    time, R, t = short_walk.walk()
    path = write(tmp_path / name, time, R, t)
    found = read_trajectory_file(path)
    assert found.format == kind.split(",")[0]
    late, off, turned = short_walk.apart(found.trajectory, time, R, t)
    assert late < 1e-4
    assert off < 1e-3
    assert turned < 0.1
    assert trajectory_format(path) in (found.format, None)
    assert found.of_camera == (found.format not in ("TUM", "EuRoC"))


@pytest.mark.parametrize(("suffix", "pack"), [(".gz", gzip.compress), (".xz", lzma.compress)])
def test_packed_files(tmp_path, suffix, pack):
    time, R, t = short_walk.walk()
    content = short_walk.mps(tmp_path / "a.csv", time, R, t).read_bytes()
    path = tmp_path / f"a.csv{suffix}"
    path.write_bytes(pack(content))
    assert short_walk.apart(read_trajectory(path), time, R, t)[1] < 1e-3


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("start", [0.0, 1_700_000_000.0])
@pytest.mark.parametrize("fps", [30.0, 200.0, 1.5])
def test_the_unit_of_time_follows_from_the_numbers(tmp_path, unit, start, fps):
    time, R, t = short_walk.walk(fps=fps, seconds=20)
    scale = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    stamps = (start + time) * scale
    path = short_walk.lines(
        tmp_path / "a.txt",
        short_walk.numbers(stamps if unit == "s" else stamps.astype(np.int64), t, short_walk.quat_xyzw(R)),
    )
    found = read_trajectory_file(path)
    assert found.time_unit == unit
    assert np.abs(np.diff(found.trajectory.timestamps.numpy()) - 1 / fps).max() < 2e-3


def test_a_header_decides_between_units_and_orders(tmp_path):
    time, R, t = short_walk.walk(fps=1000.0, seconds=1.0)
    head = "timestamp_us,qx,qy,qz,qw,tx,ty,tz\n"
    rows = short_walk.numbers(np.round(time * 1e6).astype(np.int64), short_walk.quat_xyzw(R), t)
    path = short_walk.lines(tmp_path / "a.csv", rows, head, ",")
    assert short_walk.apart(read_trajectory(path), time, R, t)[1] < 1e-3
    assert read_trajectory_file(path).time_unit == "us"
    assert short_walk.apart(read_trajectory(path), time, R, t)[2] < 0.1


def test_frame_numbers_want_a_rate(tmp_path):
    time, R, t = short_walk.walk(start=0.0)
    quat, shift = short_walk.in_camera(R, t)
    rows = [[f"frame_{k:06d}.jpg", *row] for k, row in enumerate(short_walk.numbers(quat, shift))]
    path = short_walk.lines(tmp_path / "poses.txt", rows)
    with pytest.raises(WearcapError, match="frame numbers instead of times.*fps=30"):
        read_trajectory(path)
    found = read_trajectory_file(path, fps=30.0)
    assert found.time_unit == "frames"
    assert max(short_walk.apart(found.trajectory, time, R, t)[:2]) < 1e-3


def test_folders_are_read_by_what_they_hold(tmp_path):
    time, R, t = short_walk.walk()
    (tmp_path / "sparse/0").mkdir(parents=True)
    short_walk.colmap_binary(tmp_path / "sparse/0/images.bin", time, R, t)
    assert short_walk.apart(read_trajectory(tmp_path), time, R, t)[1] < 1e-3
    with pytest.raises(WearcapError, match="a folder without a trajectory"):
        read_trajectory(tmp_path / "sparse")


def test_our_own_file_comes_back(tmp_path):
    generator = torch.Generator().manual_seed(3)
    R = rotation.exp(torch.randn(30, 3, generator=generator))
    times = 1_700_000_000 + torch.arange(30, dtype=torch.float64) / 30
    track = Trajectory(times, R, torch.randn(30, 3, generator=generator))
    write_tum(track, tmp_path / "t.txt")
    back = read_trajectory(tmp_path / "t.txt")
    assert (back.timestamps - track.timestamps).abs().max() < 1e-6
    assert rotation.geodesic(back.R_world_body, track.R_world_body).max() < 1e-3
    assert (back.t_world_body - track.t_world_body).abs().max() < 1e-6


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no poses"),
        ("# nothing\n", "no poses"),
        ("1 2 3\n", "line 1 has 3 fields"),
        ("1,2,3\n", "line 1 has 3 fields"),
        ("a,b,c,d,e,f,g,h\n", "not a trajectory"),
        ("1 0 0 0 0 0 0 one\n", "line 1: .*one"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0\n", "line 2 has 6 fields"),
        ("#\n1 0 0 0 0 0 0 nan\n", "0 poses in its 1 rows; 1 rows without a pose"),
        ("1 1e300 0 0 0 0 0 1\n", "line 1: translation is NaN or infinite"),
        ("1 0 0 0 0 0 0 0\n", "0 poses in its 1 rows"),
        ("1 0 0 0 0 0 0 3\n", "line 1: quaternion .* has norm 3"),
        ("1 0 0 0 0 0 0 1\n\n1 0 0 0 0 0 0 1\n", "1 poses in its 2 rows; 1 rows that repeat a time"),
        (
            "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n4000 0 0 0 0 0 0 1\n",
            "a gap of 1.11 hours before line 4",
        ),
        ("1 0 0 0 1 0 0 0 1 0 0 0\n2 0 0 0 1 0 0 0 1 0 0 0\n", "line 1 is no rotation"),
    ],
)
def test_defects_are_named_by_line(tmp_path, text, message):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(WearcapError, match=message):
        read_trajectory(tmp_path / "t.txt")


def test_times_of_no_recording_are_refused_without_a_grid(tmp_path):
    """Nanoseconds called seconds, and rows that are far apart: memory stays near the file's size."""
    time, R, t = short_walk.walk()
    rows = short_walk.numbers(np.round(time * 1e9).astype(np.int64), t, short_walk.quat_xyzw(R))
    path = short_walk.lines(tmp_path / "a.txt", rows)
    sparse = short_walk.lines(
        tmp_path / "b.txt",
        short_walk.numbers(
            np.where(time > 1004, time + 500, time) + np.arange(240) // 10 * 30, t, short_walk.quat_xyzw(R)
        ),
    )
    tracemalloc.start()
    try:
        read_trajectory(path)
        with pytest.raises(WearcapError, match="a gap of"):
            read_trajectory(path, time_unit="s")
        with pytest.raises(WearcapError, match="poses in .* % of"):
            read_trajectory(sparse)
        assert tracemalloc.get_traced_memory()[1] < 10 * path.stat().st_size + 500_000
    finally:
        tracemalloc.stop()


def test_arrays_of_objects_are_never_loaded(tmp_path):
    np.save(tmp_path / "poses.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(WearcapError, match="Python objects"):
        read_trajectory(tmp_path / "poses.npy")
    np.save(tmp_path / "poses.npy", np.zeros((4, 5)))
    with pytest.raises(WearcapError, match=r"shape \(4, 5\)"):
        read_trajectory(tmp_path / "poses.npy")


@settings(max_examples=100, deadline=None)
@given(st.text(alphabet="0123456789.-e, #\nnaif", max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("fuzz") / "t.txt"
    path.write_text(text)
    try:
        track = read_trajectory(path)
        assert np.isfinite(track.t_world_body.numpy()).all()
    except WearcapError:
        pass


@pytest.mark.real
def test_aria_and_its_ground_truth(real_data):
    closed = read_trajectory_file(real_data / "aria_mps/closed_loop_trajectory.csv.xz")
    assert closed.format == "MPS"
    assert len(closed.trajectory) > 1000


def test_rows_are_sorted_and_what_repeats_or_holds_no_pose_is_counted(tmp_path):
    time, R, t = short_walk.walk()
    rows = short_walk.numbers(time, t, short_walk.quat_xyzw(R))
    lost = [[f"{time[9] + 0.001:.4f}", *["nan"] * 7], [f"{time[9] + 0.002:.4f}", *["0"] * 7]]
    mixed = [*rows[:50], *rows[40:60], *reversed(rows[60:80]), *lost, *rows[80:]]
    found = read_trajectory_file(short_walk.lines(tmp_path / "t.txt", mixed))
    assert max(short_walk.apart(found.trajectory, time, R, t)) < 1e-3
    assert [note.split()[0] for note in found.notes] == ["2", "20", "10"], found.notes


def test_a_map_s_coordinates_keep_their_precision_and_their_origin(tmp_path):
    time, R, t = short_walk.walk()
    offset = np.array([458074.6, 5429380.17, 162.9])
    found = read_trajectory_file(short_walk.tum(tmp_path / "t.txt", time, R, t + offset))
    assert found.origin is not None
    assert np.abs(found.trajectory.t_world_body.double().numpy() + found.origin - t - offset).max() < 1e-5
    assert "a map's coordinates" in found.notes[0]
    with pytest.raises(WearcapError, match="positions at a map's coordinates"):
        read_trajectory(tmp_path / "t.txt")
    millimetres = read_trajectory_file(short_walk.tum(tmp_path / "mm.txt", time, R, 1000 * t))
    assert millimetres.origin is None


@pytest.mark.real
def test_a_walk_at_a_map_s_coordinates_is_that_walk(real_data):
    local = read_trajectory_file(real_data / "field/A_same_walk_local.txt").trajectory
    mapped = read_trajectory_file(real_data / "field/A_utm_walk.txt")
    apart = mapped.trajectory.t_world_body.double() - local.t_world_body
    assert (apart - apart.mean(0)).abs().max() < 1e-4
    for name in ("C_tum_repeated_rows.txt", "C_tum_unsorted.txt"):
        found = read_trajectory_file(real_data / "field" / name)
        assert found.notes
        assert len(found.trajectory) == len(local)
        assert (found.trajectory.t_world_body - local.t_world_body).abs().max() < 1e-5
