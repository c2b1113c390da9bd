import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.trajectory import Trajectory
from wearcap.io.formats.poses import read_euroc, read_tum, write_tum


def random_track(n=30):
    generator = torch.Generator().manual_seed(3)
    rotvec = torch.randn(n, 3, generator=generator)
    return Trajectory(
        1_700_000_000 + torch.arange(n, dtype=torch.float64) / 30,
        rotation.exp(rotvec),
        torch.randn(n, 3, generator=generator),
    )


def test_tum_round_trip(tmp_path):
    track = random_track()
    write_tum(track, tmp_path / "t.txt")
    back = read_tum(tmp_path / "t.txt")
    assert (back.timestamps - track.timestamps).abs().max() < 1e-6
    assert rotation.geodesic(back.R_world_body, track.R_world_body).max() < 1e-3
    assert (back.t_world_body - track.t_world_body).abs().max() < 1e-6


def test_tum_scalar_comes_last(tmp_path):
    """A quarter turn about z, scalar last: x goes to y."""
    (tmp_path / "t.txt").write_text("# time\n\n1.5 1 2 3 0 0 0.70710678 0.70710678\n")
    track = read_tum(tmp_path / "t.txt")
    assert track.R_world_body[0, :, 0].tolist() == pytest.approx([0, 1, 0], abs=1e-6)
    assert track.t_world_body[0].tolist() == [1, 2, 3]


def test_euroc_scalar_comes_first(tmp_path):
    header = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z [],v_x [m s^-1]\n"
    lines = (
        "1403636580838555648,4.6,-1.7,0.8,0.70710678,0,0,0.70710678,0.1\n1403636580843555648,4.7,-1.7,0.8,1,0,0,0,0.1\n"
    )
    (tmp_path / "data.csv").write_text(header + lines)
    track = read_euroc(tmp_path / "data.csv")
    assert track.R_world_body[0, :, 0].tolist() == pytest.approx([0, 1, 0], abs=1e-6)
    assert track.timestamps.diff().item() == pytest.approx(0.005, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no poses"),
        ("1 2 3\n", "line 1 has 3 fields"),
        ("1 0 0 0 0 0 0 one\n", "one"),
        ("1 0 0 0 0 0 0 nan\n", "quaternion is NaN"),
        ("1 1e300 0 0 0 0 0 1\n", "translation is NaN or infinite"),
        ("1 0 0 0 0 0 0 0\n", "unit quaternions"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "timestamps that rise"),
    ],
)
def test_tum_defects(tmp_path, text, message):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(WearcapError, match=message):
        read_tum(tmp_path / "t.txt")


def test_euroc_defects(tmp_path):
    for text, message in {"": "no poses", "1,2,3\n": "not an EuRoC", "a,b,c,d,e,f,g,h\n": "not an EuRoC"}.items():
        (tmp_path / "e.csv").write_text(text)
        with pytest.raises(WearcapError, match=message):
            read_euroc(tmp_path / "e.csv")


@settings(max_examples=100, deadline=None)
@given(st.text(alphabet="0123456789.-e, #\nnaif", max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("fuzz") / "t.txt"
    path.write_text(text)
    for read in (read_tum, read_euroc):
        try:
            track = read(path)
            assert np.isfinite(track.t_world_body.numpy()).all()
        except WearcapError:
            pass
