"""Paths in files stay inside their folder, and what lies there is a file or a folder."""

import os

import pytest
from safetensors.torch import save_file
from torch import zeros

from hostile import in_time
from wearcap.boundary.opening import path_inside
from wearcap.boundary.tensors import open_tensors, read_tensors
from wearcap.errors import WearcapError

NAMES = (
    *("", "/proc/kmsg", "..", "../x.ply", "a/../../x.ply", "link.ply", "linked/x.ply", "a\0b", "a\nb", "a\\b"),
    *("x" * 300, "pipe", "/", "//x", 3, None, ["x.ply"], "\ud800"),
)


@pytest.mark.parametrize("name", NAMES, ids=repr)
def test_names_that_leave_the_folder_are_refused(name, tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    (tmp_path / "x.ply").write_text("")
    (folder / "link.ply").symlink_to(tmp_path / "x.ply")
    (folder / "linked").symlink_to(tmp_path)
    os.mkfifo(folder / "pipe")
    with in_time(5), pytest.raises(WearcapError) as refused:
        path_inside(folder, name, "recording r")
    assert "\n" not in str(refused.value)


def test_names_inside_are_paths(tmp_path):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans/a b.ply").write_text("")
    (tmp_path / "to.ply").symlink_to(tmp_path / "scans/a b.ply")
    for name in ("scans/a b.ply", "to.ply", "scans", "none.ply", "./scans/a b.ply", "ä/ö.ply"):
        assert path_inside(tmp_path, name, "recording r") == tmp_path / name


def test_a_link_to_itself_is_no_file(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    path = path_inside(tmp_path, "loop", "recording r")
    with pytest.raises(WearcapError, match="loop"):
        open_tensors(path, "file")


def test_a_header_that_is_longer_than_any_is_not_read(tmp_path):
    save_file({"a": zeros(3)}, tmp_path / "a.safetensors")
    assert read_tensors(tmp_path / "a.safetensors", "file")[1]["a"].shape == (3,)
    path = tmp_path / "b.safetensors"
    header = (
        b"{" + b",".join(b'"%d":{"dtype":"F32","shape":[0],"data_offsets":[0,0]}' % k for k in range(600_000)) + b"}"
    )
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with in_time(5), pytest.raises(WearcapError, match="larger than|tensors"):
        open_tensors(path, "file")
    path.write_bytes((1 << 60).to_bytes(8, "little") + b"{}")
    with in_time(5), pytest.raises(WearcapError, match="not a readable file"):
        open_tensors(path, "file")
    os.mkfifo(tmp_path / "c.safetensors")
    with in_time(5), pytest.raises(WearcapError, match="a pipe"):
        open_tensors(tmp_path / "c.safetensors", "file")
