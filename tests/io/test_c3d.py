"""C3D files, written by the library with known markers: units, axes, gaps, prefixes; hostile ones; a person through all doors."""

import gzip
import struct

import numpy as np
import pytest
import torch

import wearcap
from c3d_files import trial, write_c3d
from command_line import exit_code
from marker_person import markers_of, person, squats
from wearcap.errors import WearcapError
from wearcap.io.conventions import Conventions
from wearcap.io.formats.c3d_markers import read_c3d, read_markers
from wearcap.io.formats.trc import Markers
from wearcap.metrics.gait import knee_deg

pytest.importorskip("c3d", reason='needs the extra: pip install "wearcap[biomechanics]"')


@pytest.mark.parametrize("form", [{}, {"unit": "m"}, {"screen": "+Y"}, {"first": 51}, {"analog": 3}], ids=str)
def test_what_was_written_is_read(tmp_path, form):
    known, read = trial(), read_c3d(write_c3d(trial(), tmp_path / "a.c3d", **form))
    assert read.names == ("Anna:LASI", "Anna:RASI")
    assert torch.allclose(read.t_world_marker, known.t_world_marker, atol=1e-6, equal_nan=True)
    assert torch.allclose(read.timestamps, known.timestamps + (form.get("first", 1) - 1) / 100)
    assert read.left_out == ("3 analog channels" if "analog" in form else "")


def test_it_may_be_packed_and_what_it_states_overruled(tmp_path):
    path = write_c3d(trial(), tmp_path / "a.c3d", unit="m")
    packed = tmp_path / "a.c3d.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    read = read_markers(packed, Conventions(unit="mm", up="y"))
    known = trial().t_world_marker / 1000
    assert torch.allclose(
        read.t_world_marker, torch.stack([known[..., 0], -known[..., 2], known[..., 1]], -1), atol=1e-6, equal_nan=True
    )


def test_unlabelled_points_are_left_out(tmp_path):
    read = read_c3d(write_c3d(trial(names=("LASI", "*17", "", "RASI")), tmp_path / "a.c3d", prefix=""))
    assert read.names == ("LASI", "RASI")


def test_a_person_goes_through_every_door(tmp_path, capsys):
    squat = squats(person(), 1.0)
    path = write_c3d(markers_of(squat), tmp_path / "squat.c3d", analog=2)
    recording = wearcap.read(path)
    assert recording.motion is not None
    assert (knee_deg(recording.motion) - knee_deg(squat)).abs().max() < 6
    assert "2 analog channels" in recording.note
    assert exit_code(["doctor", str(path)]) == 0
    assert "2 analog channels" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_markers_that_are_never_seen_are_not_there(tmp_path):
    names = markers_of(squats(person(), 0.1)).names
    unseen = torch.full((5, len(names), 3), torch.nan, dtype=torch.float64)
    path = write_c3d(Markers(torch.arange(5).double() / 100, names, unseen), tmp_path / "a.c3d")
    with pytest.raises(WearcapError, match="too few markers of the pelvis"):
        wearcap.read(path)


def _patched(content: bytes, at: int, value: int) -> bytes:
    return content[:at] + struct.pack("<H", value) + content[at + 2 :]


HOSTILE = {
    "empty": lambda content: b"",
    "a text": lambda content: b"Frame#\tTime\tLASI\n" * 100,
    "a header alone": lambda content: content[:512],
    "cut in the parameters": lambda content: content[:700],
    "cut in the frames": lambda content: content[:-600],
    "65535 points": lambda content: _patched(content, 2, 65535),
    "65535 frames": lambda content: _patched(content, 8, 65535),
    "parameters beyond the end": lambda content: b"\xff" + content[1:],
    "no labels": lambda content: content.replace(b"LABELS", b"LABELX"),
    "zeros": lambda content: bytes(4096),
}


@pytest.mark.parametrize("change", HOSTILE)
def test_hostile_files_raise(tmp_path, change):
    content = write_c3d(trial(100), tmp_path / "a.c3d").read_bytes()
    (tmp_path / "b.c3d").write_bytes(HOSTILE[change](content))
    with pytest.raises(WearcapError, match="b.c3d"):
        read_c3d(tmp_path / "b.c3d")


def test_dimensions_that_no_bytes_fill_end_at_once(tmp_path):
    """255³ labels of no letters would keep the library busy for minutes."""
    content = write_c3d(trial(), tmp_path / "a.c3d").read_bytes()
    at = content.index(b"LABELS") + len(b"LABELS") + 2
    assert content[at + 1] == 2, "an array of two dimensions"
    (tmp_path / "b.c3d").write_bytes(content[: at + 1] + b"\x04\x00\xff\xff\xff" + content[at + 5 :])
    with pytest.raises(WearcapError, match="b.c3d"):
        read_c3d(tmp_path / "b.c3d")


def test_a_bomb_is_not_unpacked(tmp_path):
    (tmp_path / "a.c3d.gz").write_bytes(gzip.compress(bytes(1 << 26)))
    with pytest.raises(WearcapError, match="100 times"):
        read_c3d(tmp_path / "a.c3d.gz")


def test_mutations_raise_or_are_read(tmp_path):
    content, random = write_c3d(trial(20), tmp_path / "a.c3d", analog=3).read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        changed = bytearray(content)
        for at in random.integers(0, 1600, random.integers(1, 6)):
            changed[at] = random.choice([0, 1, 127, 128, 255, random.integers(256)])
        (tmp_path / "b.c3d").write_bytes(changed)
        try:
            read_c3d(tmp_path / "b.c3d")
        except WearcapError:
            refused += 1
    assert 20 < refused < 280
