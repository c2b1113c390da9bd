"""Exported archives that a stranger changed: PyTorch would run texts of them as Python, so they are refused."""

import json
import os
import zipfile
from pathlib import Path

import pytest
import torch

from wearcap.errors import WearcapError
from wearcap.export.files import open_pt2


class Pair(torch.nn.Module):
    """Two inputs of one batch size, so that the archive has a guard and a symbolic size."""

    def __init__(self):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(2))

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (torch.cat([a, b]) * self.scale).reshape(-1, 2)


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("archive") / "pair.pt2"
    sizes = {0: torch.export.Dim("batch", min=2, max=64)}
    inputs = {"a": torch.ones(4, 2), "b": torch.ones(4, 2)}
    program = torch.export.export(Pair(), (), inputs, dynamic_shapes=dict.fromkeys(inputs, sizes))
    torch.export.save(program, path)
    with zipfile.ZipFile(path) as whole:
        examples = next(name for name in whole.namelist() if "sample_inputs" in name)
    return rewritten(path, path.with_name("plain.pt2"), {examples: lambda _: b""})


def rewritten(source: Path, target: Path, changes: dict) -> Path:
    """A copy of an archive with some of its parts changed, by the ends of their names."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as new:
        for entry in old.infolist():
            content = old.read(entry)
            for name, change in changes.items():
                content = change(content) if entry.filename.endswith(name) else content
            new.writestr(entry.filename, content)
    return target


def test_a_plain_archive_runs(archive):
    assert open_pt2(archive)(a=torch.ones(3, 2), b=torch.ones(3, 2)).shape == (6, 2)


def deep(tree: object, key: str, value: object) -> int:
    """Set every member of a name; the number of them."""
    if isinstance(tree, list):
        return sum(deep(item, key, value) for item in tree)
    if not isinstance(tree, dict):
        return 0
    count = sum(deep(item, key, value) for item in tree.values())
    if key in tree:
        tree[key] = value
    return count + (key in tree)


ATTACKS = {
    "a guard": ("guards_code", ["__import__('os').mkdir('MARK') == None"]),
    "a guard behind a guard": ("guards_code", ["L['a'].size()[0] == 2 or __import__('os').mkdir('MARK')"]),
    "a size": ("expr_str", "__import__('os').mkdir('MARK')"),
    "a size within a symbol": ("expr_str", "Symbol('s0', positive=__import__('os').mkdir('MARK'))"),
    "a call": ("target", "torch.os.mkdir"),
    "a hub": ("target", "torch.hub.load"),
    "an operator that finds attributes": ("target", "_operator.attrgetter"),
    "a pickle": ("use_pickle", True),
    "metadata": ("metadata", {"source_fn_st": "torch.os.mkdir"}),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_what_is_not_arithmetic_is_refused(attack, archive, tmp_path):
    key, value = ATTACKS[attack]
    value, mark = json.loads(json.dumps(value).replace("MARK", str(tmp_path / "mark"))), tmp_path / "mark"
    found = []

    def poisoned(content: bytes) -> bytes:
        tree = json.loads(content)
        found.append(deep(tree, key, value))
        return json.dumps(tree).encode()

    path = rewritten(archive, tmp_path / "x.pt2", {".json": poisoned})
    assert sum(found), "the archive has such a member"
    with pytest.raises(WearcapError, match=r"x\.pt2: the archive holds"):
        open_pt2(path)
    assert not mark.exists()


def test_sample_inputs_compressed_parts_and_damage_are_refused(archive, tmp_path):
    path = rewritten(archive, tmp_path / "x.pt2", {"sample_inputs/model.pt": lambda _: b"pickle"})
    with pytest.raises(WearcapError, match="pickled objects"):
        open_pt2(path)
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(WearcapError, match="compressed parts"):
        open_pt2(path)
    whole = archive.read_bytes()
    at = whole.index(b"guards_code")
    path.write_bytes(whole[:at] + b"G" + whole[at + 1 :])
    with pytest.raises(WearcapError, match="not a readable .pt2"):
        open_pt2(path)
    assert os.path.exists(path)
