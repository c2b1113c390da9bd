"""Checkpoints that a stranger wrote: nothing in them runs, nothing in them fills the memory, whatever reads them."""

import builtins
import copy
import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from command_line import exit_code
from wearcap.errors import WearcapError
from wearcap.models import build as module
from wearcap.models.checkpoint import load_trained, read_checkpoint
from wearcap_testing import small_dataset

pytestmark = pytest.mark.usefixtures("trusted")

KINDS = ("ckpt", "safetensors")
WRITE = "{_target_:wearcap.files.write_text,path:'MARK',text:hi}"
INTERPOLATED = {
    "a resolver that makes a target": f"${{oc.create:{WRITE}}}",
    "a call of NumPy": "${oc.create:{_target_:numpy.savetxt,fname:'MARK',X:[1]}}",
    "a copy": "${oc.create:{_target_:shutil.copy,src:/etc/hostname,dst:'MARK'}}",
    "an unsafe load": "${oc.create:{_target_:torch.load,f:'MARK',weights_only:false}}",
    "joblib": "${oc.create:{_target_:joblib.load,filename:'MARK'}}",
    "a pickle of NumPy": "${oc.create:{_target_:numpy.load,file:'MARK',allow_pickle:true}}",
    "a resolver in a resolver": f"${{oc.create:${{oc.create:{WRITE}}}}}",
    "decoded text": f'${{oc.decode:"{WRITE}"}}',
    "an environment variable": "${oc.env:HOME}",
    "an environment variable's default": f"${{oc.env:NOTHING,{WRITE}}}",
    "another part of the config": "${model.net}",
    "a neighbour": "${.net}",
    "a parent": "${..name}",
    "selected": "${oc.select:model.net}",
    "keys": "${oc.dict.keys:model}",
    "deprecated": "${oc.deprecated:model.net}",
    "Hydra's own": "${hydra:runtime.cwd}",
    "Hydra's clock": "${now:%Y}",
    "a resolver of the user's": "${mine:MARK}",
    "within a text": "x${oc.env:HOME}y",
    "escaped": "\\${oc.env:HOME}",
    "escaped twice": f"\\\\${{oc.create:{WRITE}}}",
}
TARGETED = {
    "a function": {"_target_": "wearcap.files.write_text", "path": "MARK", "text": "hi"},
    "partial": {"_target_": "wearcap.files.write_text", "_partial_": True, "path": "MARK", "text": "hi"},
    "not recursive": {"_target_": "wearcap.files.write_text", "_recursive_": False, "path": "MARK", "text": "hi"},
    "positional": {"_target_": "wearcap.body.skeleton.xsens23", "_args_": ["MARK"]},
    "converted": {"_target_": "wearcap.body.skeleton.xsens23", "_convert_": "object"},
    "Hydra's instantiate": {"_target_": "hydra.utils.instantiate", "config": {"_target_": "os.system"}},
    "Hydra's call": {"_target_": "hydra.utils.call", "config": {"_target_": "os.system"}},
    "Hydra's get_method": {"_target_": "hydra.utils.get_method", "path": "os.system"},
    "Hydra's get_class": {"_target_": "hydra.utils.get_class", "path": "os.system"},
    "Hydra's get_object": {"_target_": "hydra.utils.get_object", "path": "os.system"},
    "a target with an interpolation": {"_target_": "${oc.env:HOME}"},
    "a target that is a list": {"_target_": ["os.system"]},
    "a target that is a config": {"_target_": {"_target_": "os.system"}},
    "no target": {"_target_": None},
    "a method": {"_target_": "wearcap.models.image_encoder.EgoViewEncoder.load", "checkpoint": "MARK"},
    "another module's import": {"_target_": "wearcap.models.build.importlib.import_module", "name": "os"},
    "an interpolated key": {f"${{oc.create:{WRITE}}}": 1},
    "partial without a target": {"_partial_": True},
    "partial by a word": {"_target_": "wearcap.body.skeleton.xsens23", "_partial_": "yes"},
    "too long a text": {"text": "x" * 2000},
    "too many values": {"list": list(range(20_000))},
    "no number": {"lr": float("nan")},
}
FORMS = INTERPOLATED | TARGETED | {f"{name}, in a list": [value] for name, value in INTERPOLATED.items()}


def checkpoint(path: Path, model: dict, state: dict | None = None) -> Path:
    """A run's checkpoint or a shared one, by the path's suffix, of a model and weights (MocapEvery's autoencoder's)."""
    state = dict(read_checkpoint("motion_autoencoder")[1]) if state is None else state
    config = json.dumps({"name": "toy", "model": model})
    if path.suffix == ".ckpt":
        torch.save({"wearcap": {"config": config}, "state_dict": state}, path)
    else:
        save_file(state, path, {"wearcap_checkpoint": config})
    return path


def model_with(value: object, mark: Path) -> dict:
    """A whole model with a value that does not belong there."""
    model = copy.deepcopy(read_checkpoint("motion_autoencoder")[0]["model"])
    return json.loads(json.dumps(model | {"extra": value}).replace("MARK", str(mark)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", FORMS)
def test_nothing_in_a_config_is_resolved_or_called(form, kind, tmp_path, monkeypatch):
    mark = tmp_path / "mark"
    path = checkpoint(tmp_path / f"x.{kind}", model_with(FORMS[form], mark))
    monkeypatch.setattr(builtins, "eval", None)
    with pytest.raises(WearcapError, match=r"x\.\w+: the model('s config has| is to be made of)"):
        load_trained(path)
    assert not mark.exists()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data")).root


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("verb", ["export", "share", "evaluate", "capture", "train"])
def test_no_command_runs_what_a_checkpoint_asks_for(verb, kind, data, tmp_path, capsys):
    mark = tmp_path / "mark"
    path = checkpoint(tmp_path / f"x.{kind}", model_with(INTERPOLATED["a resolver that makes a target"], mark))
    arguments = {
        "export": ["export", f"checkpoint={path}", f"output={tmp_path}/x.onnx"],
        "share": ["export", f"checkpoint={path}", "format=safetensors", f"output={tmp_path}/y.safetensors"],
        "evaluate": ["evaluate", f"checkpoint={path}", f"dataset={data}", "baselines=false"],
        "capture": ["capture", "pipeline=hmd2", f"checkpoint={path}", f"recording={data}/r4"],
        "train": [
            "train",
            "debug=fast",
            f"data.sources.simulated.root={data}",
            f"resume={path}",
            "callbacks.progress=null",
            "trainer.accelerator=cpu",
            "data.dataset.window=60",
            f"paths.outputs={tmp_path}/outputs",
        ],
    }[verb]
    assert exit_code([*arguments, f"hydra.run.dir={tmp_path}/run"]) == 2
    printed = capsys.readouterr().err
    assert f"{path}: " in printed
    assert "Traceback" not in printed
    assert not mark.exists()
    assert not (tmp_path / "y.safetensors").exists()


def test_every_part_that_a_config_may_name_is_there_and_makes_no_foreign_call():
    """Classes, and two functions; each defined in the module that the table names."""
    for modules, names in module.TARGETS.items():
        home = __import__(modules, fromlist=names)
        for name in names:
            target = getattr(home, name)
            assert isinstance(target, type) or (modules, name) in {
                ("wearcap.body.skeleton", "xsens23"),
                ("wearcap.training.schedules", "warmup_cosine"),
            }
            if modules.startswith("wearcap"):
                assert target.__module__ == modules


def sizes(value: object, path: tuple = ()) -> list[tuple]:
    """Places of whole numbers in a config."""
    if isinstance(value, dict):
        return [place for key, inner in value.items() for place in sizes(inner, (*path, key))]
    if isinstance(value, list):
        return [place for key, inner in enumerate(value) for place in sizes(inner, (*path, key))]
    return [path] if isinstance(value, int) and not isinstance(value, bool) else []


def changed(value, path: tuple, number: int):
    value = copy.deepcopy(value)
    part = value
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = number
    return value


MEMORY = """
import resource, sys, json
from wearcap.models.checkpoint import load_trained
import wearcap.systems.echo.training, wearcap.systems.hmd2.training
from wearcap.errors import WearcapError
load_trained("hmd2")  # what a network of ours takes, with all imports
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[1:]:
    try:
        load_trained(path)
    except WearcapError:
        pass
print(json.dumps((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024))
"""


def test_giant_sizes_take_no_memory(tmp_path):
    """Every whole number of two models, and of one without weights, made giant: refused, before anything is allocated."""
    files = []
    for name in ("hmd2", "voxel_autoencoder"):
        config, state = read_checkpoint(name)
        for path in sizes(config["model"]):
            for number in (100_000, 1 << 20, 10**12):
                few = {"a": torch.zeros(1)} if number == 100_000 else state
                target = tmp_path / f"{len(files)}.safetensors"
                files.append(checkpoint(target, changed(config["model"], path, number), few))
    assert len(files) > 50
    limit = 8 << 30
    process = subprocess.run(
        [sys.executable, "-c", MEMORY, *map(str, files)],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )
    assert json.loads(process.stdout) < 150, "MiB"


def test_long_trainings_and_any_seed_are_no_giants(tmp_path):
    config, state = read_checkpoint("hmd2")
    config["model"]["optimization"]["seed"] = 2**62
    config["model"]["optimization"]["scheduler"] |= {"total": 10**9}
    load_trained(checkpoint(tmp_path / "x.safetensors", config["model"], state))


def test_weights_that_repeat_themselves_without_memory_are_refused(tmp_path):
    state = {"net.weight": torch.zeros(1).expand(1 << 20, 1 << 20)}
    torch.save(
        {"wearcap": {"config": json.dumps({"model": model_with(1, tmp_path)})}, "state_dict": state},
        tmp_path / "x.ckpt",
    )
    with pytest.raises(WearcapError, match="a network's named tensors"):
        read_checkpoint(tmp_path / "x.ckpt")


@pytest.mark.parametrize("kind", KINDS)
def test_a_config_that_is_nested_or_long_without_end_is_refused(kind, tmp_path):
    for text, message in (
        ('{"model":' + '{"a":' * 100_000, "nested too deeply|lists and objects"),
        ('{"model":{"a":"' + "x" * (1 << 21) + '"}}', "larger than 1 MiB|bytes that describe"),
    ):
        path = tmp_path / f"x.{kind}"
        if kind == "ckpt":
            torch.save({"wearcap": {"config": text}, "state_dict": {}}, path)
        else:
            save_file({"a": torch.zeros(1)}, path, {"wearcap_checkpoint": text})
        with pytest.raises(WearcapError, match=message):
            read_checkpoint(path)
