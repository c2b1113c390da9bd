"""Training the baselines: the regressor learns, its losses vanish for the truth, and every experiment runs."""

import csv
import json
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from torch import nn

from benchmarks.rivals import SEARCH, compose
from benchmarks.rivals.pose_regression.features import TrackedPoints
from benchmarks.rivals.pose_regression.net import PoseRegressor
from benchmarks.rivals.pose_regression.training import PoseRegression
from wearcap.body.skeleton import xsens23
from wearcap.cli import evaluate, train
from wearcap.data.transforms import Mirror, Shift
from wearcap.data.windows import Source, Windows
from wearcap.errors import WearcapError
from wearcap.models.checkpoint import load_trained
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.training_windows import HeadContent
from wearcap.training.base import Optimization
from wearcap_testing import small_dataset

pytestmark = pytest.mark.usefixtures("few_statistics")

SMALL = ("width=32", "layers=1", "heads=4", "feedforward=32")
HANDS = ("head", "left_wrist", "right_wrist")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data")).root


def arguments(experiment: str, data: Path, run: Path, *more: str) -> list[str]:
    return [
        SEARCH,
        f"experiment={experiment}",
        f"data.sources.simulated.root={data}",
        "debug=fast",
        "~callbacks.capture",
        f"hydra.run.dir={run}",
        f"paths.outputs={run.parent}",
        "trainer.accelerator=cpu",
        "trainer.precision=32-true",
        "data.dataset.window=60",
        "trainer.log_every_n_steps=1",
        "trainer.enable_progress_bar=false",
        "callbacks.progress=null",
        *(f"model.net.{'transformer.' if experiment.endswith('_style') else ''}{size}" for size in SMALL),
        *more,
    ]


def system(points: tuple[str, ...] = HANDS, net=PoseRegressor) -> PoseRegression:
    weights = {"root": 0.05, "rotation": 1.0, "joints": 1.0, "velocity": 0.05}
    return PoseRegression(
        lambda **sizes: net(**sizes, window=20, width=32, layers=1, heads=4, feedforward=32, dropout=0.0),
        TrackedPoints(points),
        xsens23(),
        60.0,
        weights,
        Optimization(torch.optim.AdamW),
        pairs=2,
    )


def batch(data: Path, split: str = "train", mirror: bool = False):
    varied = {"shift": Shift(), "mirror": Mirror()}
    windows = Windows(
        [Source(str(data))], split, mirror, content=HeadContent(), window=60, stride=30, fps=60.0, transforms=varied
    )
    return windows.batch(torch.arange(16) % len(windows), torch.arange(16))


class Oracle(nn.Module):
    """Returns the poses that it was given."""

    window = 20

    def __init__(self, **sizes):
        super().__init__()

    def forward(self, features, valid):
        return self.answer


def encoded(R_parent_joint: torch.Tensor, R_world_head: torch.Tensor) -> torch.Tensor:
    return HeadFeatures().encode(R_parent_joint, R_world_head, torch.zeros(*R_world_head.shape[:2], 2))


@pytest.mark.parametrize("mirror", [False, True])
def test_the_truth_costs_nothing_and_another_pose_does(data, mirror):
    module, windows = system(net=Oracle).eval(), batch(data, mirror=mirror)
    ends = module.frame_pairs(windows)
    assert ends[0].tolist() == [14, 15, 44, 45]
    rows = torch.arange(16)[:, None]
    truth = encoded(windows.R_parent_joint[rows, ends], windows.R_world_head[rows, ends]).flatten(0, 1)
    module.net.answer = truth
    assert all(term < 1e-5 for term in module.terms(windows).values())
    module.net.answer = truth + 0.2 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    assert all(term > 0.01 for term in module.terms(windows).values())


def test_padding_is_no_lesson(data):
    """The recording of 90 frames ends within a window of 120: predictions behind its end cost nothing."""
    windows = Windows([Source(str(data))], "train", content=HeadContent(), window=120, stride=30, fps=60.0)
    (track,) = (windows.packed.length == 90).nonzero()[0]
    one = windows.batch((windows.starts[:, 0] == track).nonzero()[0], torch.zeros(1).long())
    module = system(net=Oracle).eval()
    ends = module.frame_pairs(one)
    assert one.valid[0, ends[0]].tolist() == [True, True, True, False]
    answer = encoded(one.R_parent_joint[:, ends[0]], one.R_world_head[:, ends[0]])[0]
    answer[3] += 1.0
    module.net.answer = answer
    assert all(term < 1e-5 for term in module.terms(one).values())


def test_it_learns_and_hands_help(data):
    """A body that sways: after some steps the error of held-out frames has fallen by a third, and hands lower it."""
    errors = {}
    for points in (("head",), HANDS):
        torch.manual_seed(0)
        module, windows = system(points), batch(data, mirror=True)
        module.set_statistics(
            Windows([Source(str(data))], "train", content=HeadContent(), window=60, stride=30, fps=60.0), limit=16
        )
        optimizer = torch.optim.AdamW(module.parameters(), lr=3e-3)
        before = module.eval().terms(windows)["joints"].item()
        for _ in range(40):
            module.train()
            loss = sum(module.loss_weights[name] * term for name, term in module.terms(windows).items())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        errors[points] = module.eval().terms(windows)["joints"].item()
        assert errors[points] < 0.67 * before
    assert errors[HANDS] < errors[("head",)]


def test_trained_evaluated_and_refused(data, tmp_path):
    run = tmp_path / "run"
    train.main(arguments("pose_regressor_hands", data, run))
    checkpoint = run / "checkpoints" / "last.ckpt"
    loaded, config = load_trained(checkpoint)
    assert isinstance(loaded, PoseRegression)
    assert loaded.points.size == 54
    assert config["model"]["points"]["points"] == list(HANDS)
    with open(run / "metrics.csv") as file:
        assert [row["train/joints"] for row in csv.DictReader(file) if row["train/joints"]]
    common = [SEARCH, f"checkpoint={checkpoint}", f"hydra.run.dir={tmp_path}/e", "seeds=[0]", "baselines=false"]
    evaluate.main([*common, "pipeline=pose_regressor", f"output={tmp_path}/table.json"])
    scores = json.loads((tmp_path / "table.json").read_text())["methods"]["wearcap"]
    assert 0 < scores["hand_pe_cm"]["mean"] < scores["mpjpe_cm"]["mean"] + 10
    with pytest.raises(WearcapError, match="HMD2 cannot run PoseRegression"):
        evaluate.main([*common, "pipeline=hmd2"])


@pytest.mark.parametrize(
    ("experiment", "inputs"), [("baseline/avatarposer_head", 18), ("baseline/avatarposer_hands", 54)]
)
def test_the_full_size_is_avatarposers(experiment, inputs):
    """4.12 M parameters (Jiang et al. 2022), with their 22 joints for our 23."""
    config = compose("train", [f"experiment={experiment}", "paths.run=x", "trainer.max_steps=4"])
    full = instantiate(config.model, _convert_="all")
    assert full.points.size == inputs
    assert abs(sum(parameter.numel() for parameter in full.net.parameters()) / 4.12e6 - 1) < 0.02


BASELINES = {
    "baseline/egoego_style": "baseline/egoego_style",
    "baseline/egoallo_style": "baseline/egoallo_style",
    "baseline/agrol_style": "baseline/agrol_style",
    "baseline/avatarposer_head": "pose_regressor",
    "baseline/avatarposer_hands": "pose_regressor",
    "pose_regressor_head": "pose_regressor",
}
"""Experiments, and the pipelines that capture with their checkpoints."""


@pytest.mark.slow
@pytest.mark.parametrize(("experiment", "pipeline"), BASELINES.items(), ids=BASELINES)
def test_a_baseline_learns_in_a_few_steps_and_captures(experiment, pipeline, data, tmp_path):
    run = tmp_path / "run"
    small = ("trainer.max_steps=50", "data.loading.steps_per_epoch=50", "optimizer.scheduler.warmup=2")
    small += ("optimizer.optimizer.lr=0.01",)
    train.main(arguments(experiment, data, run, *small, "data.loading.batch_size=8"))
    with open(run / "metrics.csv") as file:
        losses = [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]
    assert sum(losses[-5:]) < 0.85 * sum(losses[:5])
    windows = ["pipeline.sampling.steps=2", "pipeline.overlap.stride=50"]
    evaluate.main(
        [
            SEARCH,
            f"checkpoint={run}/checkpoints/last.ckpt",
            f"hydra.run.dir={tmp_path}/e",
            "seeds=[0]",
            "baselines=false",
            f"pipeline={pipeline}",
            *(windows if pipeline != "pose_regressor" else []),
            f"output={tmp_path}/table.json",
        ]
    )
    assert 0 < json.loads((tmp_path / "table.json").read_text())["methods"]["wearcap"]["mpjpe_cm"]["mean"] < 100
