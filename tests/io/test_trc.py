"""Marker files: TRC in its units and axes, UI-PRMD in both its forms."""

import lzma
from pathlib import Path

import numpy as np
import pytest
import torch

from data_prep.ui_prmd import NAMES, read_ui_prmd
from marker_person import write_trc
from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.formats.trc import Markers, read_trc

HEAD = "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tUnits\n{rates}\nFrame#\tTime\tA\t\t\tS:B\t\t\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
ROWS = "1\t0.0\t1\t2\t3\t4\t5\t6\n2\t0.5\t1\t2\t3\t\t\t\n3\t1.0\t1\t2\t3\n"


def trc(path: Path, rates: str = "2\tcm", rows: str = ROWS) -> Path:
    path.write_text(HEAD.format(rates=rates) + rows)
    return path


@pytest.mark.parametrize(
    ("up", "first"),
    [("auto", [0.01, -0.03, 0.02]), ("y", [0.01, -0.03, 0.02]), ("z", [0.01, 0.02, 0.03]), ("x", [0.02, 0.03, 0.01])],
)
def test_units_axes_and_empty_fields(tmp_path, up, first):
    markers = read_trc(trc(tmp_path / "a.trc"), Conventions(up=up))
    assert markers.names == ("A", "S:B")
    assert markers.timestamps.tolist() == [0.0, 0.5, 1.0]
    assert markers.t_world_marker[0, 0].tolist() == pytest.approx(first)
    assert markers.t_world_marker[:, 1].isnan().all(-1).tolist() == [False, True, True]


def test_a_written_file_is_read(tmp_path):
    places = torch.randn(7, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    places[2, 1] = torch.nan
    write_trc(Markers(torch.arange(7).double() / 100, ("LASI", "RASI"), places), tmp_path / "a.trc")
    read = read_trc(tmp_path / "a.trc")
    assert read.names == ("Anna:LASI", "Anna:RASI")
    assert torch.allclose(read.t_world_marker, places, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize(
    ("rates", "rows", "says"),
    [
        ("2\tfurlong", ROWS, "unit"),
        ("2\tmm", "1\t0.0\tx\t2\t3\t4\t5\t6\n", "line 7.*'x'"),
        ("2\tmm", ROWS + "4\t0.2\t1\t2\t3\t4\t5\t6\n", "rise|before|order"),
        ("2\tmm", "", "0 numbers"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, rates, rows, says):
    with pytest.raises(WearcapError, match=says):
        read_trc(trc(tmp_path / "a.trc", rates, rows))


@pytest.mark.parametrize("up", ["-y", "-z"])
def test_an_axis_that_points_down_is_refused(tmp_path, up):
    with pytest.raises(WearcapError, match="up="):
        read_trc(trc(tmp_path / "a.trc"), Conventions(up=up))


def test_both_forms_of_ui_prmd_hold_the_same(tmp_path):
    mm = np.random.default_rng(0).normal(0, 800, (12, 3 * len(NAMES))).round(2)
    mm[4, :3] = 0
    (tmp_path / "t.txt").write_text("\n".join(",".join(f"{value:.2f}" for value in row) for row in mm) + "\n")
    steps = np.diff(np.diff((100 * mm).round().astype(np.int64), axis=0, prepend=0), axis=0, prepend=0)
    np.save(tmp_path / "t.npy", steps.astype(np.int32))
    (tmp_path / "t.d2.npy.xz").write_bytes(lzma.compress((tmp_path / "t.npy").read_bytes()))
    text, packed = read_ui_prmd(tmp_path / "t.txt"), read_ui_prmd(tmp_path / "t.d2.npy.xz")
    assert text.t_world_marker[4, 0].isnan().all()
    assert packed.timestamps[-1] == pytest.approx(0.11)
    assert torch.allclose(text.t_world_marker, packed.t_world_marker, atol=1e-9, equal_nan=True)
    assert text.t_world_marker[0, 1].tolist() == pytest.approx((mm[0, 3:6] / 1000).tolist())
    np.save(tmp_path / "short.npy", steps[:, :9])
    with pytest.raises(WearcapError, match="117"):
        read_ui_prmd(tmp_path / "short.npy")


@pytest.mark.real
def test_a_real_trial_stands_upright(real_data):
    path = next((real_data / "ui_prmd" / "trials" / "s07").glob("m08_*_e03.d2.npy.xz"))
    at = dict(zip(NAMES, read_ui_prmd(path).t_world_marker.nanmean(0)[:, 2].tolist()))
    heights = [at[name] for name in ("LFHD", "C7", "T10", "LPSI", "LTHI", "LKNE", "LTIB", "LANK")]
    assert heights == sorted(heights, reverse=True)
    assert 1.4 < heights[0] < 1.8
