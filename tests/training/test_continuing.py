"""Runs that go on in their own folder, start from weights, tell every logger their config, and score what they made."""

import json
import shutil
from pathlib import Path
from typing import ClassVar

import lightning
import pytest
import torch
import yaml
from hydra.utils import instantiate
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies import FSDPStrategy
from omegaconf import OmegaConf

from wearcap.cli import evaluate, train
from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.models.checkpoint import read_checkpoint, share_checkpoint
from wearcap.training.callbacks import StepsProgressBar
from wearcap.training.loggers import read_metrics
from wearcap.training.run import differing_keys, resume_path, run_to_continue
from wearcap_testing import small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")
SMALL = [
    "model.net.transformer.width=32",
    "model.net.transformer.layers=1",
    "model.net.transformer.heads=4",
    "model.net.transformer.feedforward=32",
]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return small_dataset(tmp_path_factory.mktemp("data")).root


def arguments(data: Path, outputs: Path, *more: str) -> list[str]:
    return [
        "experiment=motion_diffusion_head",
        f"data.sources.simulated.root={data}",
        "debug=fast",
        f"paths.outputs={outputs}",
        "data.dataset.window=60",
        "trainer.accelerator=cpu",
        "trainer.max_steps=2",
        "optimizer.scheduler.total=8",
        "logger.csv.flush_logs_every_n_steps=1",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "trainer.enable_model_summary=false",
        "callbacks.progress=null",
        "callbacks.capture=null",
        *SMALL,
        *more,
    ]


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory) -> Path:
    """A run of seed 0 in the folder of its name."""
    outputs = tmp_path_factory.mktemp("outputs")
    train.main(arguments(data, outputs, f"hydra.run.dir={outputs}/train/debug_fast/first"))
    return outputs / "train/debug_fast/first"


@pytest.fixture
def runs(trained, tmp_path) -> Path:
    """A copy of that run where tests may go on with it; the folder of outputs."""
    shutil.copytree(trained, tmp_path / "train/debug_fast/first")
    return tmp_path


def folders(outputs: Path) -> set[str]:
    return {path.parents[1].name for path in (outputs / "train/debug_fast").glob("*/checkpoints/last.ckpt")}


def test_auto_goes_on_in_the_folder_of_the_same_seed_and_config(data, runs):
    run = runs / "train/debug_fast/first"
    train.main(arguments(data, runs, "resume=auto", "trainer.max_steps=4"))
    assert folders(runs) == {"first"}
    assert read_checkpoint(run / "checkpoints/last.ckpt")[0]["training"]["steps"] == 4
    assert [row["step"] for row in read_metrics(run / "metrics.csv") if "train/loss" in row] == ["0", "1", "2", "3"]


def test_auto_leaves_another_seeds_run_alone(data, runs, trusted):
    other = f"hydra.run.dir={runs}/train/debug_fast/other"
    train.main(arguments(data, runs, "resume=auto", "seed=5", other))
    assert folders(runs) == {"first", "other"}
    assert read_checkpoint(runs / "train/debug_fast/first/checkpoints/last.ckpt")[0]["training"]["steps"] == 2
    # Of two runs each is gone on with by its own seed.
    train.main(arguments(data, runs, "resume=auto", "trainer.max_steps=4"))
    steps = {
        name: read_checkpoint(runs / f"train/debug_fast/{name}/checkpoints/last.ckpt")[0]["training"]["steps"]
        for name in ("first", "other")
    }
    assert steps == {"first": 4, "other": 2}


@pytest.mark.parametrize("own", [False, True])
def test_auto_refuses_another_config_with_the_keys_that_differ(own, data, runs):
    folder = [f"hydra.run.dir={runs}/train/debug_fast/first"] if own else []
    changed = ["resume=auto", "optimizer.optimizer.lr=0.5", "data.dataset.stride=7", *folder]
    before = (runs / "train/debug_fast/first/config.yaml").read_text()
    with pytest.raises(WearcapError, match="another config") as caught:
        train.main(arguments(data, runs, *changed))
    assert "optimizer.optimizer.lr (0.002, now 0.5)" in str(caught.value)
    assert "data.dataset.stride" in str(caught.value)
    assert "trainer" not in str(caught.value).split("Expected")[0]
    assert (runs / "train/debug_fast/first/config.yaml").read_text() == before
    assert folders(runs) == {"first"}


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
DAMAGED = {
    "an alias bomb": BOMB,
    "a list": "[1, 2]",
    "nothing": "",
    "no paths": "seed: 0\n",
    "paths of another type": "seed: 0\npaths: 3\n",
    "no YAML": "seed: [0",
    "nested": "seed: 0\na: " + "[" * 5000,
    "binary": "seed: \0",
    "a date that is none": "seed: 0\npaths: {run: 2001-99-99}\n",
    "an unhashable key": "? [a]\n: b\n",
    "a giant": "seed: 0\na: " + "x" * (1 << 20),
    "a tag": "!!python/object/apply:os.mkdir [mark]\n",
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_config_of_a_run_does_not_break_the_others(damage, data, runs):
    """Runs of one name lie side by side: resume=auto goes on with the whole one, and says what it passes over."""
    broken = runs / "train/debug_fast/broken"
    shutil.copytree(runs / "train/debug_fast/first", broken)
    (broken / "config.yaml").write_text(DAMAGED[damage])
    record = OmegaConf.to_yaml(compose("train", [*arguments(data, runs), "paths.run=RUN"]), resolve=True)
    with pytest.warns(UserWarning, match=r"cannot be gone on with: .*config\.yaml"):
        assert run_to_continue(runs / "train/debug_fast", record) == runs / "train/debug_fast/first"
    with pytest.raises(WearcapError, match=r"config\.yaml"):
        resume_path("auto", broken, record)


CRAFTED = {
    "optimiser of another type": {"optimizer_states": "x"},
    "no optimiser": {"optimizer_states": []},
    "an optimiser's state of another shape": {
        "optimizer_states": [{"state": {0: {"exp_avg": torch.zeros(1)}}, "param_groups": [{}]}]
    },
    "groups of another type": {"optimizer_states": [{"state": {}, "param_groups": 3}]},
    "schedulers of another type": {"lr_schedulers": [3]},
    "loops of another type": {"loops": 3},
    "loops without progress": {"loops": {"fit_loop": {"state_dict": {}}}},
    "an epoch that is text": {"epoch": "x"},
    "a step that is a list": {"global_step": [1]},
    "callbacks of another type": {"callbacks": {"RunRecord": 3, "ModelCheckpoint": 3}},
    "a config that is no JSON": {"wearcap": {"config": "{"}},
    "a config of another type": {"wearcap": 3},
    "no version": {"pytorch-lightning_version": None},
}


@pytest.mark.parametrize("part", CRAFTED)
def test_a_crafted_checkpoint_ends_a_resume_in_one_line_or_not_at_all(part, data, trained, tmp_path, trusted):
    saved = torch.load(trained / "checkpoints/last.ckpt", weights_only=True)
    torch.save(saved | CRAFTED[part], tmp_path / "x.ckpt")
    run = [f"resume={tmp_path}/x.ckpt", f"hydra.run.dir={tmp_path}/run", "trainer.max_steps=3"]
    message = f"{tmp_path}/x.ckpt: "
    try:
        train.main(arguments(data, tmp_path, *run))
    except WearcapError as error:
        message = str(error)
    assert message.startswith(f"{tmp_path}/x.ckpt: ")
    assert "\n" not in message


def test_keys_that_differ_are_those_that_train_differently():
    before = "paths: {run: /a/b}\nseed: 0\ntrainer: {max_steps: 3, precision: 32}\nfolder: /a/b/pictures\n"
    now = "paths: {run: /c}\nseed: 0\ntrainer: {max_steps: 9, precision: 16}\nfolder: /c/pictures\nnew: 1\n"
    assert differing_keys(yaml.safe_load(before), now) == ["trainer.precision (32, now 16)", "new (nothing, now 1)"]


@pytest.mark.parametrize("kind", ["ckpt", "safetensors"])
def test_a_training_starts_from_weights(kind, data, trained, tmp_path):
    source = trained / "checkpoints/last.ckpt"
    if kind == "safetensors":
        share_checkpoint(source, tmp_path / "shared.safetensors")
        source = tmp_path / "shared.safetensors"
    run = tmp_path / "run"
    still = ["optimizer.optimizer.lr=1e-12", "optimizer.optimizer.weight_decay=0"]
    train.main(arguments(data, tmp_path, f"init={source}", f"hydra.run.dir={run}", "seed=3", *still))
    (config, before), (now, after) = read_checkpoint(source), read_checkpoint(run / "checkpoints/last.ckpt")
    assert now["training"]["frames"] == config["training"]["frames"] + 2 * 2 * 60, "what the weights had seen counts"
    assert before.keys() == after.keys()
    assert all(torch.allclose(before[name].float(), after[name].float(), atol=1e-6) for name in before)
    saved = torch.load(run / "checkpoints/last.ckpt", weights_only=True)
    assert saved["global_step"] == 2, "the optimiser and its steps begin anew"


def test_weights_of_another_model_are_named_in_one_line(data, trained, tmp_path, trusted):
    source, run = trained / "checkpoints/last.ckpt", f"hydra.run.dir={tmp_path}/run"
    saved = torch.load(source, weights_only=True)
    saved["state_dict"]["net.stranger"] = torch.zeros(2)
    torch.save(saved, tmp_path / "odd.ckpt")
    with pytest.raises(WearcapError) as caught:
        train.main(
            arguments(
                data,
                tmp_path,
                f"init={tmp_path}/odd.ckpt",
                run,
                "model.net.transformer.layers=2",
                "+features.contacts=true",
            )
        )
    text = str(caught.value)
    assert text.startswith(f"{tmp_path}/odd.ckpt: its weights are not this model's; ")
    assert "missing: net." in text
    assert "1 unexpected: net.stranger" in text
    assert "of another size: " in text
    assert "here [" in text
    with pytest.raises(WearcapError, match="Expected one of them"):
        train.main(arguments(data, tmp_path, f"init={source}", f"resume={source}", run))


class Listening(Logger):
    """A logger that keeps what it is given."""

    heard: ClassVar[list[dict]] = []
    name = property(lambda self: "listening")  # pyright: ignore[reportAssignmentType]
    version = property(lambda self: "0")  # pyright: ignore[reportAssignmentType]

    def log_hyperparams(self, params, *args, **kwargs):
        self.heard.append(params)

    def log_metrics(self, metrics, step=None):
        pass


def test_every_logger_hears_config_and_parameters(data, tmp_path):
    Listening.heard.clear()
    logger = f"+logger.listening._target_={Listening.__module__}.Listening"
    train.main(arguments(data, tmp_path, logger, f"hydra.run.dir={tmp_path}/run", "seed=7"))
    (heard,) = Listening.heard
    assert (heard["seed"], heard["optimizer"]["optimizer"]["lr"]) == (7, 0.002)
    assert heard["parameters"] == read_checkpoint(tmp_path / "run/checkpoints/last.ckpt")[0]["training"]["parameters"]


@pytest.mark.slow
def test_wandb_has_the_config_offline(data, tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("WANDB_MODE", "offline")
    train.main(arguments(data, tmp_path, "logger=wandb", f"hydra.run.dir={tmp_path}/run", "seed=7"))
    assert wandb.run is not None
    assert wandb.run.config["seed"] == 7
    assert wandb.run.config["parameters"] > 0
    wandb.finish()
    assert list((tmp_path / "run").rglob("*.wandb"))


def test_a_training_is_scored_as_evaluate_scores_it(data, tmp_path):
    run = tmp_path / "run"
    train.main(arguments(data, tmp_path, "test=true", f"hydra.run.dir={run}", "pipeline.sampling.steps=1"))
    scored = json.loads((run / "test.json").read_text())
    assert set(scored["methods"]) == {"wearcap", "mean pose", "nearest window"}
    again = [f"checkpoint={run}/checkpoints/best.ckpt", "pipeline.sampling.steps=1", f"output={tmp_path}/again.json"]
    evaluate.main([*again, f"hydra.run.dir={tmp_path}/e"])
    assert json.loads((tmp_path / "again.json").read_text())["methods"] == scored["methods"]


def test_a_network_that_captures_nothing_is_not_tested(data, tmp_path):
    given = arguments(data, tmp_path, "test=true", f"hydra.run.dir={tmp_path}/run")[1 : -len(SMALL) - 3]
    with pytest.raises(WearcapError, match="test=true, but no pipeline captures with MotionEncoding"):
        train.main(
            [
                "experiment=motion_autoencoder",
                *[each for each in given if "window" not in each and "capture" not in each],
                "test=true",
                f"hydra.run.dir={tmp_path}/run",
            ]
        )


class Steps(lightning.LightningModule):
    """One weight, three batches an epoch."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def training_step(self, batch, index):
        return self.weight

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=1.0)

    def train_dataloader(self):
        return [0, 1, 2]


@pytest.mark.parametrize(("limits", "total"), [({"max_steps": 8, "max_epochs": -1}, 8), ({"max_epochs": 3}, 9)])
def test_progress_is_in_steps_of_the_whole_run(limits, total):
    shown = []

    class Watch(lightning.Callback):
        def on_train_batch_end(self, trainer, pl_module, *batch):
            task = bar.train_progress_bar
            shown.append((task.completed, task.total, task.description.split("]")[-1]))

    bar = StepsProgressBar()
    lightning.Trainer(
        accelerator="cpu",
        **limits,
        callbacks=[bar, Watch()],
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
    ).fit(Steps())
    assert [done for done, _, _ in shown] == list(range(1, total + 1))
    assert {of for _, of, _ in shown} == {total}
    assert shown[-1][2] == "epoch 2, steps"


def test_the_default_bar_is_this_one():
    assert compose("train", ["paths.run=x"]).callbacks.progress._target_.endswith("StepsProgressBar")


def test_sharded_training_composes_and_wants_gpus(data, tmp_path):
    """Lightning shards on GPUs alone: here the strategy is built, and the trainer refuses this machine in one line."""
    config = compose("train", ["trainer=fsdp", "callbacks.average=null", "trainer.devices=4", "paths.run=x"]).trainer
    strategy = instantiate(config.strategy)
    assert isinstance(strategy, FSDPStrategy)
    assert (config.devices, config.accelerator, config.gradient_clip_algorithm) == (4, "gpu", "value")
    given = arguments(data, tmp_path, f"hydra.run.dir={tmp_path}/run", "callbacks.average=null", "trainer.devices=2")
    with pytest.raises(WearcapError, match="FSDP") as caught:
        train.main(["trainer=fsdp", *given])
    assert "\n" not in str(caught.value)
