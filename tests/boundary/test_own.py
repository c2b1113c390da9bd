"""Files of formats that can run code: the user's own open, those of strangers get one line that says what to ask for."""

import json
import os
import zipfile
from pathlib import Path

import lightning  # its messages go to the stream that is there when it is imported
import pytest
import torch

from command_line import exit_code
from wearcap.boundary import own
from wearcap.boundary.own import remember_own, require_own, trusting
from wearcap.errors import WearcapError
from wearcap.export.files import export_network, open_pt2
from wearcap.models.checkpoint import read_checkpoint
from wearcap.models.weights import read_weights
from wearcap.runtime.graphs import Graph

assert lightning
ONE_LINE = r"from elsewhere, which can run code.* Ask for the \.safetensors or \.onnx export, or give trust=true"


class Sum(torch.nn.Module):
    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return torch.cat([a, b], -1).sum(-1)


@pytest.fixture
def exported(tmp_path) -> Path:
    inputs = {"a": torch.ones(4, 2), "b": torch.ones(4, 2)}
    export_network(Graph(Sum(), inputs), tmp_path / "mine/sum.pt2", "pt2", 1e-5)
    return tmp_path / "mine/sum.pt2"


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    config, state = read_checkpoint("motion_autoencoder")
    path = tmp_path / "elsewhere/x.ckpt"
    path.parent.mkdir()
    torch.save({"wearcap": {"config": json.dumps(config)}, "state_dict": state}, path)
    return path


def test_what_was_exported_here_opens_where_it_was_written_and_with_trust(exported, tmp_path):
    assert open_pt2(exported)(a=torch.ones(3, 2), b=torch.ones(3, 2)).tolist() == [4, 4, 4]
    copy = tmp_path / "copy.pt2"
    copy.write_bytes(exported.read_bytes())
    with pytest.raises(WearcapError, match=ONE_LINE):
        open_pt2(copy)
    with trusting(True):
        assert open_pt2(copy)(a=torch.ones(3, 2), b=torch.ones(3, 2)).tolist() == [4, 4, 4]
    with pytest.raises(WearcapError, match=ONE_LINE):
        open_pt2(copy)


def test_an_archive_whose_parts_have_other_names_runs_nothing(exported, tmp_path):
    """PyTorch takes any part of `models/` by its name less five characters, and evaluates the texts in it."""
    mark, path = tmp_path / "mark", tmp_path / "evil.pt2"
    code = f"__import__('os').mkdir('{mark}')"
    with zipfile.ZipFile(exported) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as new:
        for name in old.namelist():
            content = old.read(name)
            if name.endswith("models/model.json"):
                name, tree = name.replace(".json", ".jsox"), json.loads(content)
                tree["guards_code"] = [f"{code} == None"]
                content = json.dumps(tree).encode()
            new.writestr(name, content)
    with pytest.raises(WearcapError, match=ONE_LINE):
        open_pt2(path)
    assert not mark.exists()


def test_a_checkpoint_from_elsewhere_opens_in_outputs_in_a_run_and_with_trust(checkpoint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(WearcapError, match=ONE_LINE) as refused:
        read_checkpoint(checkpoint)
    assert "\n" not in str(refused.value)
    with trusting(True):
        name = read_checkpoint(checkpoint)[0]["name"]
    for folder in ("outputs/train/x/checkpoints", "my run/checkpoints"):
        (tmp_path / folder).mkdir(parents=True)
        copy = tmp_path / folder / "last.ckpt"
        copy.write_bytes(checkpoint.read_bytes())
        if "run" in folder:
            with pytest.raises(WearcapError, match=ONE_LINE):
                read_checkpoint(copy)
            remember_own(tmp_path / "my run")
        assert read_checkpoint(copy)[0]["name"] == name
    (tmp_path / "outputs/link.ckpt").symlink_to(checkpoint)
    with pytest.raises(WearcapError, match=ONE_LINE):
        read_checkpoint("outputs/link.ckpt")


def test_a_small_file_of_weights_does_not_unpack_to_a_large_one(tmp_path):
    """Packed parts count as what they unpack to; of two directories in one file PyTorch is shown the one that was counted."""
    for name, size in (("small", 2), ("large", 1 << 24)):
        torch.save({"a": torch.zeros(size)}, tmp_path / f"{name}.pth")
        with (
            zipfile.ZipFile(tmp_path / f"{name}.pth") as old,
            zipfile.ZipFile(tmp_path / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as new,
        ):
            for part in old.namelist():
                new.writestr(part, old.read(part))
    packed = tmp_path / "packed.pth"
    packed.write_bytes((tmp_path / "large.zip").read_bytes())
    assert packed.stat().st_size < 100_000
    with pytest.raises(WearcapError, match="unpacks to more than"):
        read_weights(packed)
    # The end of the directory that PyTorch finds is the large one's, Python's the small one's.
    large, small = ((tmp_path / f"{name}.zip").read_bytes() for name in ("large", "small"))
    packed.write_bytes(large + small)
    assert read_weights(packed)["a"].shape == (2,)


@pytest.mark.parametrize("verb", ["export", "evaluate", "capture", "train resume", "train init"])
def test_commands_say_it_in_one_line_and_take_trust(verb, checkpoint, tmp_path, capsys):
    key = {"train resume": "resume", "train init": "init"}.get(verb, "checkpoint")
    arguments = [verb.split()[0], f"{key}={checkpoint}", f"hydra.run.dir={tmp_path}/run"]
    arguments += {"capture": [f"recording={tmp_path}/none"], "evaluate": [f"dataset={tmp_path}/none"]}.get(verb, [])
    if verb.startswith("train"):
        arguments += ["debug=fast", f"data.sources.simulated.root={tmp_path}/none", f"paths.outputs={tmp_path}/out"]
    for trust in (False, True):
        assert exit_code([*arguments, *(["trust=true"] if trust else [])]) == 2
        printed = capsys.readouterr().err
        assert "Traceback" not in printed
        assert ("from elsewhere" in printed) == (not trust)
    assert own.TRUST not in os.environ


def test_without_a_cache_folder_nothing_is_remembered(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("WEARCAP_CACHE", str(tmp_path / "file"))
    remember_own(tmp_path)
    with pytest.raises(WearcapError, match=ONE_LINE):
        require_own(tmp_path / "x.ckpt")
