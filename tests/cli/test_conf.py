"""Hydra through `wearcap.cli.conf`: composition, multirun, and typos that name their nearest neighbour."""

import json
from pathlib import Path

import pytest

from wearcap.cli import conf
from wearcap.errors import WearcapError

FILES = {
    "train.yaml": """
defaults: [_self_, data: simulated, trainer: cpu, experiment: null]
seed: 1
out: ???
hydra: {run: {dir: "${oc.env:RUNS}/run"}, sweep: {dir: "${oc.env:RUNS}/sweep"}}
""",
    "data/simulated.yaml": "name: simulated\nfps: 60\n",
    "data/cmu.yaml": "name: cmu\nfps: 60\n",
    "trainer/cpu.yaml": "max_steps: 10\nprecision: ${precision_default}\n",
    "experiment/motion_diffusion_head.yaml": "# @package _global_\nseed: 7\n",
}


@pytest.fixture(autouse=True)
def small_conf(tmp_path, monkeypatch):
    for name, text in FILES.items():
        path = tmp_path / "conf" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setenv("RUNS", str(tmp_path))
    monkeypatch.setattr(conf, "conf_dir", lambda: tmp_path / "conf")
    return tmp_path


def record(config):
    """A task: leave what was composed in the run's folder."""
    from hydra.core.hydra_config import HydraConfig

    folder = Path(HydraConfig.get().runtime.output_dir)
    (folder / "seen.json").write_text(json.dumps({"seed": config.seed, "data": config.data.name}))


def refuse(config):
    raise WearcapError(f"seed {config.seed} refused", fix="Take another.")


def test_compose_applies_overrides():
    config = conf.compose("train", ["data=cmu", "trainer.max_steps=3", "experiment=motion_diffusion_head"])
    assert (config.data.name, config.trainer.max_steps, config.seed) == ("cmu", 3, 7)


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("trainer.max_stepz=3", "'trainer.max_steps'"),
        ("experiment=motion_difusion_head", "'motion_diffusion_head'"),
        ("data=smulated", "'simulated'"),
        ("dta=simulated", "'data'"),
        ("sead=3", "'seed'"),
        ("~sead", "'seed'"),
    ],
)
@pytest.mark.parametrize("through", ["compose", "hydra_main", "multirun"])
def test_a_typo_names_the_nearest_valid_word(override, named, through):
    run = {
        "compose": lambda: conf.compose("train", [override]),
        "hydra_main": lambda: conf.hydra_main("train", record, [override]),
        "multirun": lambda: conf.hydra_main("train", record, [override, "-m"]),
    }
    with pytest.raises(WearcapError) as caught:
        run[through]()
    assert "Did you mean" in str(caught.value)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_config_name_is_named():
    with pytest.raises(WearcapError, match="'train'"):
        conf.hydra_main("train", record, ["--config-name", "trian"])


def test_unreadable_override_and_missing_value():
    with pytest.raises(WearcapError, match="cannot read the override"):
        conf.compose("train", ["seed=[1,"])
    with pytest.raises(WearcapError, match=r"out.*Give it on the command line: out="):
        conf.hydra_main("train", lambda config: config.out, [])


def test_a_run_calls_the_task_once(small_conf):
    conf.hydra_main("train", record, ["data=cmu", "seed=4"])
    assert json.loads((small_conf / "run/seen.json").read_text()) == {"seed": 4, "data": "cmu"}


def test_multirun_visits_every_combination(small_conf):
    conf.hydra_main("train", record, ["-m", "seed=1,2", "data=cmu,simulated"])
    seen = [json.loads(path.read_text()) for path in sorted(small_conf.glob("sweep/*/seen.json"))]
    assert {(s["seed"], s["data"]) for s in seen} == {(s, d) for s in (1, 2) for d in ("cmu", "simulated")}


@pytest.mark.slow
def test_multirun_through_the_joblib_launcher(small_conf):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    conf.hydra_main("train", record, ["-m", "seed=1,2", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"])
    assert len(list(small_conf.glob("sweep/*/seen.json"))) == 2


@pytest.mark.parametrize("arguments", [["seed=3"], ["-m", "seed=3"]])
def test_the_tasks_own_error_comes_out_as_it_is(arguments):
    with pytest.raises(WearcapError, match=r"^seed 3 refused. Take another.$"):
        conf.hydra_main("train", refuse, arguments)


def test_show_config_and_help(capsys):
    conf.hydra_main("train", record, ["--cfg", "job", "data=cmu"])
    assert "name: cmu" in capsys.readouterr().out
    with pytest.raises(SystemExit) as caught:
        conf.hydra_main("train", record, ["--help"])
    text = capsys.readouterr().out
    assert caught.value.code == 0
    assert "data: cmu, simulated" in text
    assert "max_steps: 10" in text
