"""Shared checkpoints: written, stored in half the width, found by name, and refused when they are not what they should be."""

import copy
import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from release.registry import registry
from wearcap.errors import WearcapError
from wearcap.models import checkpoint as module
from wearcap.models.build import brought_up_to_date, build
from wearcap.models.checkpoint import (
    checkpoint_file,
    load_trained,
    read_checkpoint,
    share_checkpoint,
    shared_checkpoints,
)
from wearcap.models.weights import check_weights

pytestmark = pytest.mark.usefixtures("trusted")

MODEL = {
    "_target_": "wearcap.systems.ireplica.training.ContactDetection",
    "net": {"_target_": "wearcap.systems.ireplica.contact_sequence.ContactSequence", "_partial_": True, "width": 40},
    "skeleton": {"_target_": "wearcap.body.skeleton.xsens23"},
    "optimization": {
        "_target_": "wearcap.training.base.Optimization",
        "optimizer": {"_target_": "torch.optim.AdamW", "lr": 1e-3},
        "scheduler": {"_target_": "wearcap.training.schedules.warmup_cosine", "_partial_": True},
    },
    "parts": [{"_target_": "wearcap.diffusion.schedule.CosineSchedule"}],
}
HMD2 = "wearcap.systems.hmd2.training"
CONF = Path(__file__).parents[2] / "conf"
SOURCES = {"cmu": {"root": "datasets/cmu", "weight": 1.0}, "simulated": None}


class Net(nn.Module):
    """A weight, a bias, a statistic, a count, and one weight under two names."""

    def __init__(self, size: int = 6):
        super().__init__()
        self.first, self.second = nn.Linear(4, size), nn.Linear(4, size, bias=False)
        self.second.weight = self.first.weight
        self.register_buffer("mean", torch.full((4,), 1 / 3))
        self.register_buffer("count", torch.tensor([2**40 + 1]))


def run_file(path: Path, state: dict | None = None, **config) -> Path:
    """A run's checkpoint, as `wearcap train` saves it."""
    torch.manual_seed(0)
    config = {"name": "toy", "model": MODEL, "paths": {"run": "/home/someone"}} | config
    torch.save({"wearcap": {"config": json.dumps(config)}, "state_dict": state or Net().state_dict(), "epoch": 3}, path)
    return path


def shared_file(path: Path, state: dict | None = None, config: object = None, **metadata: str) -> Path:
    """A shared checkpoint, or what somebody calls one."""
    entries = metadata or {"wearcap_checkpoint": json.dumps(config or {"name": "toy", "model": MODEL})}
    save_file(state or {"first.weight": torch.zeros(2, 2)}, path, entries)
    return path


def test_a_shared_checkpoint_is_the_weights_and_what_others_need_of_the_config(tmp_path):
    source = run_file(tmp_path / "run.ckpt", data={"sources": SOURCES, "val_sources": None, "workers": 3})
    share_checkpoint(source, tmp_path / "shared.safetensors")
    config, state = read_checkpoint(tmp_path / "shared.safetensors")
    assert config == {"name": "toy", "model": MODEL, "data": {"sources": {"cmu": {"root": "datasets/cmu"}}}}
    original = read_checkpoint(source)[1]
    assert state.keys() == original.keys()
    assert all(torch.equal(state[name], value) for name, value in original.items())
    assert b"/home" not in (tmp_path / "shared.safetensors").read_bytes()
    check_weights(Net().state_dict(), state, "it", "shared")
    share_checkpoint(tmp_path / "shared.safetensors", tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "shared.safetensors").read_bytes()


def test_folders_of_a_machine_stay_at_home(tmp_path):
    source = run_file(tmp_path / "run.ckpt", data={"sources": {"own": {"root": "/home/someone/data"}}})
    share_checkpoint(source, tmp_path / "shared.safetensors")
    assert set(read_checkpoint(tmp_path / "shared.safetensors")[0]) == {"name", "model"}


@pytest.mark.parametrize(("dtype", "off"), [("bfloat16", 2**-8), ("float16", 2**-11)])
def test_weights_are_stored_in_half_the_width_and_statistics_are_not(dtype, off, tmp_path):
    source = run_file(tmp_path / "run.ckpt", {"net.weight": torch.randn(300, 200), "net.mean": torch.rand(200)})
    share_checkpoint(source, tmp_path / "whole.safetensors")
    share_checkpoint(source, tmp_path / "half.safetensors", dtype)
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("half", "whole")]
    assert 0.5 < sizes[0] / sizes[1] < 0.52
    before, after = (read_checkpoint(tmp_path / name)[1] for name in ("whole.safetensors", "half.safetensors"))
    assert torch.equal(after["net.mean"], before["net.mean"])
    assert after["net.weight"].dtype == torch.float32
    torch.testing.assert_close(after["net.weight"], before["net.weight"], rtol=off, atol=1e-6)
    assert not torch.equal(after["net.weight"], before["net.weight"])


def test_weights_that_are_too_large_for_a_type_are_not_shared_in_it(tmp_path):
    source = run_file(tmp_path / "run.ckpt", {"net.weight": torch.tensor([[1e5]])})
    with pytest.raises(WearcapError, match=r"'net.weight' is not finite as float16"):
        share_checkpoint(source, tmp_path / "half.safetensors", "float16")
    share_checkpoint(source, tmp_path / "half.safetensors", "bfloat16")
    broken = run_file(tmp_path / "nan.ckpt", {"net.weight": torch.tensor([[float("nan")]])})
    with pytest.raises(WearcapError, match=r"nan.ckpt: weight 'net.weight' is not finite"):
        share_checkpoint(broken, tmp_path / "nan.safetensors")
    assert not (tmp_path / "nan.safetensors").exists()


def test_what_cannot_be_shared_so_is_reported(tmp_path):
    source = run_file(tmp_path / "run.ckpt")
    with pytest.raises(WearcapError, match=r"Expected NAME\.safetensors"):
        share_checkpoint(source, tmp_path / "other.ckpt")
    with pytest.raises(WearcapError, match=r"no dtype 'bfloat'.*Did you mean 'bfloat16'"):
        share_checkpoint(source, tmp_path / "shared.safetensors", "bfloat")


def test_a_bare_name_is_a_checkpoint_of_the_project_unless_a_file_has_it(tmp_path, monkeypatch):
    share_checkpoint(run_file(tmp_path / "run.ckpt"), tmp_path / "comes_with/walker.safetensors")
    (tmp_path / "comes_with/registry.json").write_text(registry(tmp_path / "comes_with"))
    monkeypatch.setattr(module, "resource", lambda *_: tmp_path / "comes_with")
    monkeypatch.chdir(tmp_path)
    assert read_checkpoint("walker")[0]["name"] == "toy"
    assert read_checkpoint(Path("walker"))[0]["name"] == "toy"
    with pytest.raises(WearcapError, match=r"^walkr: no such checkpoint\. Expected .*Did you mean 'walker'\?$"):
        read_checkpoint("walkr")
    with pytest.raises(WearcapError, match=r"Expected one of walker\."):
        read_checkpoint("zzz")
    for path in ("walker.ckpt", "sub/walker", "walker.safetensors", "", "w" * 5000):
        with pytest.raises(WearcapError, match="no such checkpoint|a folder|cannot be read"):
            read_checkpoint(path)
    run_file(tmp_path / "walker", name="of the folder")
    assert read_checkpoint("walker")[0]["name"] == "of the folder"


def refusal(path: Path) -> str:
    with pytest.raises(WearcapError) as raised:
        read_checkpoint(path)
    assert str(raised.value).startswith(str(path))
    return str(raised.value)


@pytest.mark.parametrize(
    ("name", "old"),
    [
        ("voxel_autoencoder", "point_codes_training"),
        ("echo", '\\"object_in_wrists\\": false'),
        ("echo", '\\"whole\\": 0.'),
    ],
)
def test_files_of_before_a_name_moved_or_a_setting_went_open(name, old):
    assert old.encode() in (CONF.parent / "checkpoints" / f"{name}.safetensors").read_bytes()
    module, config = load_trained(name)
    target = config["model"]["_target_"]
    assert f"{type(module).__module__}.{type(module).__qualname__}" == target
    assert old not in json.dumps(config)
    with pytest.raises(WearcapError, match="object_in_wrists"):
        build({**config["model"], "object_in_wrists": True}, {}, "a file whose network needs what went")


def test_a_shared_checkpoint_cut_anywhere_is_refused(tmp_path):
    whole = shared_file(tmp_path / "whole.safetensors").read_bytes()
    path = tmp_path / "cut.safetensors"
    for length in (*range(0, len(whole), 7), len(whole) - 1):
        path.write_bytes(whole[:length])
        assert "not a readable checkpoint" in refusal(path)
    for junk in (b"\xff" * 64, b"\x00" * 64, whole + b"more", b"PK\x03\x04" + whole):
        path.write_bytes(junk)
        assert "not a readable checkpoint" in refusal(path)


def test_files_that_are_no_checkpoints_are_named(tmp_path):
    path = tmp_path / "x.safetensors"
    save_file({"a": torch.zeros(2)}, path)
    assert "not a checkpoint of wearcap" in refusal(path)
    assert "not a checkpoint of wearcap" in refusal(shared_file(path, wearcap="{}", format="pt"))
    assert "not readable JSON" in refusal(shared_file(path, wearcap_checkpoint="{"))
    for config in ("[]", "3", "{}", '{"model": null}', '{"model": "x"}'):
        assert "content of another layout" in refusal(shared_file(path, wearcap_checkpoint=config))
    run_file(path)  # a pickle under this name is not opened
    assert "not a readable checkpoint" in refusal(path)
    path = tmp_path / "x.ckpt"
    for content in (
        {"wearcap": 3, "state_dict": {}},
        {"wearcap": {"config": 3}, "state_dict": {}},
        {"wearcap": {"config": "{}"}},
        [1, 2],
        torch.zeros(3),
    ):
        torch.save(content, path)
        assert re.search("not a checkpoint of wearcap|but no checkpoint|named tensors", refusal(path))
    path.unlink()
    path.mkdir()
    assert "a folder" in refusal(path)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "torch.load",
        "torch.hub.load",
        "torch.optim.os.system",
        "wearcap.models.checkpoint.torch.hub.load",
        "wearcap.models.checkpoint.pickle.loads",
        "wearcap.files.write_text",
        "wearcap.models.checkpoint.share_checkpoint",
        "wearcap.training.run.record_run",
        "wearcap.cli.main.main",
        "wearcap.models.checkpoint.Path",
        "wearcap.models.nothing.Net",
        "wearcap.models",
        "",
        "wearcap.models..x.Y",
    ],
)
@pytest.mark.parametrize("kind", ["ckpt", "safetensors"])
def test_a_config_that_asks_for_anything_but_our_models_is_refused(kind, target, tmp_path):
    model = MODEL | {"net": {"_target_": "wearcap.systems.hmd2.model.MotionDenoiser", "x": [{"_target_": target}]}}
    path = tmp_path / f"bad.{kind}"
    if kind == "ckpt":
        run_file(path, model=model)
    else:
        shared_file(path, config={"model": model})
    assert f"to be made of {target!r}" in refusal(path)


def test_every_model_that_can_be_trained_can_be_shared(tmp_path):
    """A class or function that a new config names for its model has to be one that `read_checkpoint` knows."""
    targets = {
        target
        for group in ("model", "features", "optimizer")
        for path in (CONF / group).glob("*.yaml")
        for target in re.findall(r"_target_: ([\w.]+)", path.read_text(encoding="utf-8"))
    }
    assert len(targets) > 8
    for target in sorted(targets):
        read_checkpoint(shared_file(tmp_path / "x.safetensors", config={"model": {"_target_": target}}))


def test_weights_that_do_not_fit_are_named(tmp_path):
    config = {"model": MODEL}
    state = {name: value.clone() for name, value in Net(5).state_dict().items()}
    _, read = read_checkpoint(shared_file(tmp_path / "x.safetensors", state, config))
    with pytest.raises(WearcapError, match=r"another size of it: first.weight is 5×4 and should be"):
        check_weights(Net().state_dict(), read, "it", "x")
    del state["mean"]
    _, read = read_checkpoint(shared_file(tmp_path / "x.safetensors", state, config))
    with pytest.raises(WearcapError, match=r"not the weights of it: tensors 1 missing \(mean\)"):
        check_weights(Net(5).state_dict(), read, "it", "x")


@pytest.mark.parametrize("kind", ["ckpt", "safetensors"])
def test_a_flipped_bit_anywhere_in_weights_or_config_is_refused(kind, tmp_path):
    path = tmp_path / f"x.{kind}"
    source = run_file(tmp_path / "run.ckpt", {"first.weight": torch.randn(20, 20), "mean": torch.rand(4)})
    shutil.copy(source, path) if kind == "ckpt" else share_checkpoint(source, path)
    whole = path.read_bytes()
    state = read_checkpoint(path)[1]
    random = torch.Generator().manual_seed(0)
    for at in torch.randint(len(whole), (150,), generator=random).tolist():
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        try:
            _, read = read_checkpoint(path)
        except WearcapError:
            continue
        # What no checksum covers is padding, names of the archive's parts that nothing reads, and the like.
        assert all(torch.equal(read[name], value) for name, value in state.items())


def former_model(name: str) -> dict:
    """The model's config as a shared checkpoint's file has it."""
    with safe_open(str(checkpoint_file(name)), "pt") as file:
        return json.loads(file.metadata()["wearcap_checkpoint"])["model"]


def test_former_settings_are_grouped():
    config = json.loads((Path(__file__).parent / "former_hmd2.json").read_text())
    former = copy.deepcopy(config)
    brought_up_to_date(config)
    assert config["levels"] == {"_target_": f"{HMD2}.Levels", "tilt": former["level_tilt"], "pure": former["pure"]}
    loss = {"weights": former["loss_weights"], "tail": former["tail"], "contact_share": former["contact_share"]}
    assert config["loss"] == {"_target_": f"{HMD2}.Loss"} | loss
    image = {"encoder": former["image_encoder"], "size": former["image_size"]}
    both = {"points": {"encoder": former["place_encoder"]}, "image": image}
    assert config["conditions"] == {name: one | {"drop": former["drop"]} for name, one in both.items()}
    assert [*config["conditions"]] == ["points", "image"], "the order of the network's inputs"
    sizes = {name: former["net"][name] for name in ("width", "layers", "heads", "feedforward", "dropout")}
    assert config["net"]["transformer"] == {"_target_": "wearcap.models.layers.TransformerSize"} | sizes
    left = {"features", "schedule", "skeleton", "fps", "compile", "_target_"}
    assert set(config) == {*left, "net", "levels", "loss", "conditions", "optimization"}
    assert {name: config[name] for name in left} == {name: former[name] for name in left}


@pytest.mark.parametrize("name", shared_checkpoints())
def test_todays_settings_stay_as_they_are(name):
    config = former_model(name)
    former = {key: config[key] for key in ("optimizer", "scheduler", "seed") if key in config}
    grouped = config.get("optimization", {"_target_": "wearcap.training.base.Optimization"} | former)
    brought_up_to_date(config)
    once = copy.deepcopy(config)
    assert config["optimization"] == grouped
    brought_up_to_date(config)
    assert config == once
