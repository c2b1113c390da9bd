"""Contact detection end to end: experiments run, resume changes nothing, checkpoints predict and export."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from contact_motion import CLASSES, bending_dataset
from wearcap.cli import export, train
from wearcap.cli.conf import compose, load_pipeline
from wearcap.errors import WearcapError
from wearcap.metrics.detection import average_precision
from wearcap.models.checkpoint import load_trained, read_checkpoint
from wearcap.recording import RecordingStore
from wearcap.systems.ireplica.contact_prediction import ContactPredictor
from wearcap_testing import experiments

pytestmark = pytest.mark.usefixtures("few_statistics")

EXPERIMENTS = experiments("contact_")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return bending_dataset(tmp_path_factory.mktemp("data")).root


def arguments(data: Path, run: Path, experiment: str, *more: str) -> list[str]:
    return [
        f"experiment={experiment}",
        f"data.sources.simulated.root={data}",
        f"hydra.run.dir={run}",
        f"paths.outputs={run.parent}",
        "trainer.accelerator=cpu",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "callbacks.progress=null",
        "logger.csv.flush_logs_every_n_steps=1",
        *more,
    ]


def fast(data: Path, run: Path, experiment: str, *more: str) -> Path:
    train.main(arguments(data, run, experiment, "debug=fast", *more))
    return run / "checkpoints" / "last.ckpt"


def logged(run: Path, name: str) -> dict[int, str]:
    with open(run / "metrics.csv") as file:
        return {int(row["step"]): row[name] for row in csv.DictReader(file) if row.get(name)}


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_contact_experiment_takes_a_step(experiment, data, tmp_path):
    checkpoint = fast(data, tmp_path / "run", experiment)
    classes = read_checkpoint(checkpoint)[0]["model"]["classes"]
    assert set(ContactPredictor.load(checkpoint).classes) == set(classes)
    for name in classes:
        assert logged(tmp_path / "run", f"val/{name}_average_precision")


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> Path:
    return bending_dataset(tmp_path_factory.mktemp("people"), train=6).root


@pytest.fixture(scope="module")
def learned(people, tmp_path_factory) -> Path:
    """Ours, for long enough to tell bent elbows."""
    run = tmp_path_factory.mktemp("runs") / "run"
    more = [
        "trainer.max_steps=120",
        "data.loading.steps_per_epoch=60",
        "data.loading.batch_size=8",
        "data.dataset.window=120",
        "data.dataset.stride=30",
        "callbacks.average.decay=0.9",
        "optimizer.scheduler.warmup=10",
        "optimizer.optimizer.lr=0.01",
    ]
    train.main(arguments(people, run, "contact_sequence", *more))
    return run / "checkpoints" / "last.ckpt"


def test_what_was_learned_is_predicted_for_a_recording(learned, people):
    recording = RecordingStore.open(people).load("b6")
    assert recording.suit is not None
    assert recording.interactions is not None
    prob = ContactPredictor.load(learned)(recording.suit)
    for name in CLASSES:
        truth = recording.interactions.hand_contact(recording.suit.timestamps, name)
        assert average_precision(prob[name].flatten(), truth.flatten()) > 0.9


def test_the_checkpoint_carries_its_temperatures(learned):
    _, state = read_checkpoint(learned)
    assert (state["net.temperature"] != 1.0).all()
    system, config = load_trained(learned)
    assert torch.equal(system.net.temperature, state["net.temperature"])
    assert config["name"] == "contact_sequence"


def test_resumed_equals_straight_through(data, tmp_path):
    more = [
        "data.loading.steps_per_epoch=2",
        "data.loading.batch_size=2",
        "data.dataset.window=90",
        "data.loading.val_windows=4",
        "optimizer.scheduler.total=6",
    ]
    straight, first, second = (tmp_path / name for name in ("straight", "first", "second"))
    train.main(arguments(data, straight, "contact_sequence", *more, "trainer.max_steps=6"))
    train.main(arguments(data, first, "contact_sequence", *more, "trainer.max_steps=4"))
    saved = torch.load(first / "checkpoints/last.ckpt", weights_only=True)["global_step"]
    resume = f"resume={first}/checkpoints/last.ckpt"
    train.main(arguments(data, second, "contact_sequence", *more, "trainer.max_steps=6", resume))
    for name in ("train/loss", "val/loss"):
        whole, rest = logged(straight, name), logged(second, name)
        assert rest
        assert rest == {step: value for step, value in whole.items() if step >= saved}
    states = [read_checkpoint(run / "checkpoints/last.ckpt")[1] for run in (straight, second)]
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


FORMATS = ("onnx", "pt2")
RUN = """
import sys
from wearcap.export.__main__ import main

recording, *exported = sys.argv[1:]
for model in exported:
    main([model, recording, model + ".csv"])
assert not {"lightning", "hydra", "omegaconf"} & set(sys.modules)
"""


@pytest.fixture(scope="module")
def tables(learned, data, tmp_path_factory) -> dict[str, Path]:
    """What the exported file of each format predicts for a recording, in a process without Lightning and Hydra."""
    folder, source = tmp_path_factory.mktemp("exported"), RecordingStore.open(data).path_of("b3")
    models = {format: folder / format / f"contact.{format}" for format in FORMATS}
    for format, model in models.items():
        export.main([f"checkpoint={learned}", f"format={format}", f"output={model}", f"hydra.run.dir={folder}/x"])
        assert json.loads(model.with_suffix(".json").read_text())["model"]["max_abs_error"] < 1e-5
    subprocess.run([sys.executable, "-c", RUN, source, *models.values()], check=True)
    return {format: Path(f"{model}.csv") for format, model in models.items()}


@pytest.mark.slow
@pytest.mark.parametrize("format", FORMATS)
def test_the_export_runs_on_a_recording_without_lightning(learned, data, tables, format):
    with open(tables[format]) as file:
        rows = list(csv.DictReader(file))
    suit = RecordingStore.open(data).load("b3").suit
    assert suit is not None
    prob = ContactPredictor.load(learned)(suit)
    for name in CLASSES:
        for hand, side in enumerate(("left", "right")):
            written = torch.tensor([float(row[f"{side}_{name}"]) for row in rows])
            torch.testing.assert_close(written, prob[name][:, hand], atol=1e-5, rtol=0)


def test_a_contact_checkpoint_is_no_motion_denoiser(learned):
    with pytest.raises(WearcapError, match="HMD2 cannot run ContactDetection"):
        load_pipeline(learned, compose("capture", ["recording=x", "paths.run=x"]).pipeline, "cpu")


def test_foreign_checkpoints_are_named(tmp_path, learned, trusted):
    saved = torch.load(learned, weights_only=True)
    config = json.loads(saved["wearcap"]["config"])
    config["model"]["net"]["_target_"] = "somewhere.MotionDenoiser"
    torch.save({**saved, "wearcap": {"config": json.dumps(config)}}, tmp_path / "other.ckpt")
    with pytest.raises(WearcapError, match="somewhere.MotionDenoiser.*no part of wearcap"):
        ContactPredictor.load(tmp_path / "other.ckpt")
