"""Training end to end on a small data set: every experiment runs, kill and resume changes nothing."""

import csv
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from wearcap.cli import capture, evaluate, export, train
from wearcap.cli.conf import compose, conf_dir
from wearcap.errors import WearcapError
from wearcap.models.checkpoint import load_trained, read_checkpoint
from wearcap_testing import experiments, small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")
EXPERIMENTS = experiments("motion_diffusion")
KINDS = ("motion_", "contact_", "egoview", "voxel_autoencoder", "hmd2", "mocap_every", "object_encoder", "echo")
SMALL = [
    "model.net.transformer.width=32",
    "model.net.transformer.layers=1",
    "model.net.transformer.heads=4",
    "model.net.transformer.feedforward=32",
]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data")).root


def arguments(data: Path, run: Path, *more: str) -> list[str]:
    return [
        "experiment=motion_diffusion_head",
        f"data.sources.simulated.root={data}",
        "debug=fast",
        f"hydra.run.dir={run}",
        f"paths.outputs={run.parent}",
        "data.dataset.window=60",
        "trainer.accelerator=cpu",
        "logger.csv.flush_logs_every_n_steps=1",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "callbacks.progress=null",
        *SMALL,
        *more,
    ]


@pytest.fixture(scope="module")
def checkpoint(data, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    train.main(arguments(data, run))
    return run / "checkpoints" / "last.ckpt"


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_takes_a_step(experiment, data, tmp_path):
    run = tmp_path / "run"
    changed = arguments(data, run, "trainer.precision=32-true", "data.loading.batch_size=2")
    train.main([f"experiment={experiment}", *changed[1:]])
    assert (run / "checkpoints" / "last.ckpt").is_file()


def test_every_experiment_is_tried_by_a_test():
    """Each kind in a module of its own: contact detection in test_contact_detection,
    the autoencoder of FID in test_motion_autoencoder_training, of points in test_voxel_reconstruction, ours of pictures
    in test_egoview, all that sees them in test_hmd2_training; MocapEvery and its manifold in test_watch_regression; of
    objects in test_object_encoding; ECHO in test_echo_training."""
    assert experiments(*KINDS) == experiments("")


def test_a_run_leaves_its_record(checkpoint):
    run = checkpoint.parents[1]
    assert "max_steps: 4" in (run / "config.yaml").read_text()
    record = json.loads((run / "run.json").read_text())
    training = read_checkpoint(checkpoint)[0]["training"]
    assert training["machine"] == record["machine"]
    assert (training["steps"], training["frames"]) == (4, 4 * 2 * 60)
    assert 0 < training["core_seconds"] < 600
    assert 0 < training["seconds"] < 600
    assert record["versions"]["torch"] == torch.__version__.split("+")[0] or torch.__version__
    assert list((run / "pictures").glob("*.png"))


def test_the_checkpoint_rebuilds_the_system(checkpoint):
    system, config = load_trained(checkpoint)
    assert config["name"] == "debug_fast"
    trained = (parameter.numel() for parameter in system.parameters() if parameter.requires_grad)
    assert config["training"]["parameters"] == sum(trained)
    assert not torch.equal(system.net.motion_normalizer.scale, torch.ones_like(system.net.motion_normalizer.scale))


def losses(run: Path, name: str = "train/loss") -> dict[int, str]:
    with open(run / "metrics.csv") as file:
        return {int(row["step"]): row[name] for row in csv.DictReader(file) if row.get(name)}


@pytest.mark.slow
def test_killed_and_resumed_equals_straight_through(data, tmp_path):
    """A process killed in its third epoch goes on from the second's checkpoint with exactly the same losses."""
    more = ["trainer.max_steps=12", "data.loading.steps_per_epoch=3", "callbacks.capture=null", "name=kill"]
    train.main(arguments(data, tmp_path / "straight/run", *more))
    killed = tmp_path / "killed/train/kill/first"
    command = arguments(data, killed, *more, f"paths.outputs={tmp_path / 'killed'}", "trainer.max_steps=100000")
    command = [a for a in command if a != "trainer.max_steps=12"] + ["optimizer.scheduler.total=12"]
    process = subprocess.Popen([sys.executable, "-m", "wearcap.cli.main", "train", *command])
    deadline = time.monotonic() + 120
    while not (len(rows := _safe_losses(killed)) >= 7 and (killed / "checkpoints/last.ckpt").is_file()):
        assert time.monotonic() < deadline, f"no seven steps within two minutes: {rows}"
        time.sleep(0.05)
    process.kill()
    process.wait()
    saved = torch.load(killed / "checkpoints/last.ckpt", weights_only=True)["global_step"]
    resumed = tmp_path / "killed/train/kill/second"
    train.main(
        arguments(
            data, resumed, *more, f"paths.outputs={tmp_path / 'killed'}", f"resume={killed}/checkpoints/last.ckpt"
        )
    )
    straight, after = losses(tmp_path / "straight/run"), losses(resumed)
    assert after
    assert min(after) == saved
    assert after == {step: loss for step, loss in straight.items() if step >= saved}
    # The averaged weights, which validation sees, go on too.
    validated = losses(tmp_path / "straight/run", "val/loss")
    assert losses(resumed, "val/loss") == {step: loss for step, loss in validated.items() if step >= saved}


@pytest.mark.slow
def test_a_run_resumed_in_its_folder_goes_on_with_its_log(data, tmp_path, trusted):
    run = tmp_path / "run"
    more = ["data.loading.steps_per_epoch=3", "callbacks.capture=null", "optimizer.scheduler.total=12"]

    def trained(steps: int, *resume: str) -> list[tuple[int, str]]:
        train.main(arguments(data, run, *more, f"trainer.max_steps={steps}", *resume))
        with open(run / "metrics.csv") as file:
            rows = [(int(row["step"]), row["train/loss"]) for row in csv.DictReader(file)]
        return [row for row in rows if row[1]]

    first = trained(3)
    early = shutil.copy(run / "checkpoints/last.ckpt", tmp_path)
    more_steps = trained(6, "resume=auto")
    assert more_steps[:3] == first
    assert trained(9, f"resume={early}")[:6] == more_steps, "no step is there twice"
    taken = read_checkpoint(run / "checkpoints/last.ckpt")[0]["training"]
    assert (taken["steps"], taken["frames"]) == (9, 9 * 2 * 60), "the steps before it went on are counted"
    assert trained(3) == first, "a run from scratch begins its log anew"


@pytest.mark.slow
def test_a_sweep_of_two_jobs_runs(data, tmp_path):
    """The documented multirun through the joblib launcher: each job trains in a process and a folder of its own."""
    command = [argument for argument in arguments(data, tmp_path / "run") if not argument.startswith("hydra.run")]
    script = Path(__file__).parents[2] / "train.py"
    subprocess.run(
        [
            sys.executable,
            script,
            "-m",
            *command,
            f"hydra.sweep.dir={tmp_path}/sweep",
            "seed=0,1",
            "callbacks.capture=null",
            "hydra/launcher=joblib",
            "hydra.launcher.n_jobs=2",
        ],
        check=True,
        cwd=tmp_path,
    )
    trained = [losses(tmp_path / "sweep" / job) for job in ("0", "1")]
    assert len(trained[0]) == len(trained[1]) == 4
    assert trained[0] != trained[1]


def _safe_losses(run: Path) -> dict[int, str]:
    return losses(run) if (run / "metrics.csv").is_file() else {}


@pytest.mark.parametrize(("has", "used"), [(False, "32-true"), (True, "bf16-mixed")])
def test_bfloat16_is_for_cpus_that_have_instructions_for_it(has, used, data, tmp_path, monkeypatch, capsys):
    """Elsewhere a step takes tens of times as long as in float32."""
    taken = []
    monkeypatch.setattr("wearcap.training.run.computes_bfloat16", lambda: has)
    monkeypatch.setattr(train, "fit", lambda system, data, trainer, *others: taken.append(trainer.precision))
    train.main(arguments(data, tmp_path / "run", "trainer.precision=bf16-mixed"))
    assert taken == [used]
    assert ("trainer.precision=32-true, not bf16-mixed" in " ".join(capsys.readouterr().out.split())) is not has


def test_overfits_one_batch(data, tmp_path):
    run = tmp_path / "run"
    more = [
        "debug=overfit",
        "trainer.max_steps=60",
        "model.net.transformer.dropout=0",
        "data.loading.batch_size=2",
        "data.loading.steps_per_epoch=1",
        "optimizer.optimizer.lr=0.01",
        "optimizer.scheduler.warmup=5",
        "callbacks.capture=null",
    ]
    train.main([a for a in arguments(data, run, *more) if a != "debug=fast"])
    values = [float(loss) for loss in losses(run).values()]
    assert values[-1] < 0.5 * values[0]


def test_evaluate_capture_and_export(checkpoint, data, tmp_path):
    common = [f"checkpoint={checkpoint}", "pipeline.sampling.steps=2"]
    evaluate.main([*common, f"hydra.run.dir={tmp_path}/e", f"output={tmp_path}/table.json", "seeds=[0,1]"])
    table = json.loads((tmp_path / "table.json").read_text())
    assert set(table["methods"]) == {"wearcap", "mean pose", "nearest window"}
    assert table["methods"]["wearcap"]["mpjpe_cm"]["seeds"] == 2
    capture.main([*common, f"recording={data}/r4", f"hydra.run.dir={tmp_path}/c", "video=false", "body=false"])
    assert {p.name for p in (tmp_path / "c").iterdir()} >= {"motion.npz", "motion.bvh", "motion.glb"}
    export.main([*common, f"hydra.run.dir={tmp_path}/x", f"output={tmp_path}/d.pt2", "format=pt2"])
    assert (tmp_path / "d.pt2").is_file()


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "not a readable checkpoint"), (b"garbage" * 100, "the file is damaged"), (None, "no such checkpoint")],
)
def test_broken_checkpoints_are_named(content, message, tmp_path, trusted):
    path = tmp_path / "bad.ckpt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(WearcapError, match=f"bad.ckpt: {message}"):
        read_checkpoint(path)


def test_a_truncated_and_a_foreign_checkpoint_are_named(checkpoint, tmp_path, trusted):
    short = tmp_path / "short.ckpt"
    short.write_bytes(checkpoint.read_bytes()[:-5000])
    with pytest.raises(WearcapError, match="not a readable checkpoint"):
        read_checkpoint(short)
    torch.save({"state_dict": {}}, tmp_path / "foreign.ckpt")
    with pytest.raises(WearcapError, match="not a checkpoint of wearcap"):
        read_checkpoint(tmp_path / "foreign.ckpt")


def test_a_checkpoint_with_code_in_it_is_refused(tmp_path, trusted):
    torch.save({"wearcap": Path("x")}, tmp_path / "code.ckpt")
    with pytest.raises(WearcapError, match="tensors and plain values only"):
        read_checkpoint(tmp_path / "code.ckpt")


def test_a_checkpoint_of_another_model_is_named(checkpoint, tmp_path, trusted):
    saved = torch.load(checkpoint, weights_only=True)
    saved["state_dict"].pop("net.head.weight")
    torch.save(saved, tmp_path / "other.ckpt")
    with pytest.raises(WearcapError, match="not the weights of this model: tensors 1 missing .net.head.weight"):
        load_trained(tmp_path / "other.ckpt")


@pytest.mark.parametrize(
    "group",
    ["data", "features", "model", "optimizer", "trainer", "callbacks", "logger", "debug", "experiment", "pipeline"],
)
def test_every_choice_of_every_group_composes(group):
    root = conf_dir() / group
    for path in sorted(root.rglob("*.yaml")):
        name = path.relative_to(root).with_suffix("").as_posix()
        assert compose("train", [f"{group}={name}", "paths.run=x"])
