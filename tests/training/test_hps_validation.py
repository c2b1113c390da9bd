"""HPS as a validation callback: its figures follow the weights of the module that localises."""

import functools
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import lightning
import pytest
import torch
from torch import nn

from wearcap.optimize.banded import BandedSettings, solve_banded
from wearcap.optimize.costs import Loss
from wearcap.optimize.hps import HpsEnergy
from wearcap.recording import Localization, Recording
from wearcap.systems.hps.pipeline import HPS
from wearcap.systems.hps.training import HpsValidation

SQUARES = ("self", "hold", "translation_step", "root_step", "head_step", "pose", "slide", "contact_plane")
PIPELINE = HPS(
    HpsEnergy(
        {
            "self": 220.0,
            "hold": 9.0,
            "translation_step": 1e4,
            "root_step": 1e5,
            "head_step": 6e4,
            "pose": 400.0,
            "slide": 9e3,
            "contact_plane": 4.4e3,
        },
        {name: Loss("square") for name in SQUARES},
    ),
    functools.partial(solve_banded, settings=BandedSettings(iterations=2, relaxation=1.0)),
)


class Offset(lightning.LightningModule):
    """Learns where east is, a metre per step."""

    def __init__(self):
        super().__init__()
        self.east = nn.Parameter(torch.zeros(()))

    def training_step(self, batch, index):
        return -self.east

    def validation_step(self, batch, index):
        pass

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=1.0)

    def train_dataloader(self):
        return [0]

    val_dataloader = train_dataloader


@dataclass(frozen=True)
class Shifted:
    """The recording's own localisation, as far off as the module reports."""

    module: Offset

    def __call__(self, recording: Recording, folder: Path) -> Localization:
        assert not self.module.training
        found = recording.localization
        assert found is not None
        return replace(found, t_world_cam=found.t_world_cam + torch.tensor([1.0, 0.0, 0.0]) * self.module.east)

    def reads(self, recording: Recording, folder: Path) -> list:
        return []


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    sys.path.append(str(Path(__file__).parents[1] / "pipelines"))
    from hps_walk import hps_dataset, hps_recording

    root = tmp_path_factory.mktemp("data")
    hps_dataset(root, hps_recording("walk", 6.0))
    return root


def test_the_weights_of_each_epoch_are_captured(data):
    seen = []

    class Watch(lightning.Callback):
        def on_validation_end(self, trainer, pl_module):
            seen.append({name: value.item() for name, value in trainer.callback_metrics.items()})

    callback = HpsValidation(PIPELINE, Shifted, [f"{data}/walk"], every_n_epochs=2)
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=4,
        callbacks=[callback, Watch()],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=1,
    )
    module = Offset()
    trainer.fit(module)
    assert [bool(metrics) for metrics in seen[-4:]] == [False, True, True, True]
    second, fourth = seen[-3], seen[-1]
    # Each epoch's one step moves the module a metre east, and the captured body with it.
    assert second["hps/world_root_cm"] == pytest.approx(200, abs=8)
    assert fourth["hps/world_root_cm"] == pytest.approx(400, abs=8)
    assert second["hps/localized_share"] == 1.0
    assert abs(second["hps/surface_cm"]) < 1
    assert 0 <= second["hps/sliding_cm"] < 2
    assert module.training


def test_a_recording_without_truth_has_no_error(data, tmp_path):
    from hps_walk import hps_dataset, hps_recording

    from wearcap.systems.hps.training import validated

    hps_dataset(tmp_path, replace(hps_recording("walk", 4.0), motion=None))
    scores = validated(PIPELINE, f"{tmp_path}/walk")
    assert scores["world_root_cm"] != scores["world_root_cm"]
    assert scores["localized_share"] == 1.0
