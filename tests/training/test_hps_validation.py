"""HPS as a validation callback: its figures follow the weights of the module that localises."""

import functools
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import lightning
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image
from torch import nn

from wearcap.cli.conf import compose
from wearcap.errors import WearcapError
from wearcap.io.formats.camera_json import write_photos
from wearcap.io.formats.ply import Ply, write_ply
from wearcap.localization.features import RootSift
from wearcap.localization.point_map import PointMapper
from wearcap.optimize.losses import Loss
from wearcap.recording import Localization, Recording, RecordingStore
from wearcap.systems.hps.banded import BandedSettings, solve_banded
from wearcap.systems.hps.energy import HpsEnergy
from wearcap.systems.hps.pipeline import HPS
from wearcap.systems.hps.training import HpsValidation, TrainedFeatures

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


class LearnedSift(nn.Module):
    """SIFT whose descriptors pass through a layer."""

    name = "learned_sift"

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(128, 128, bias=False)
        nn.init.orthogonal_(self.layer.weight)

    def forward(self, image):
        found = RootSift(400)(image)
        descriptors = nn.functional.normalize(self.layer(torch.from_numpy(found.descriptors)), dim=-1)
        return replace(found, descriptors=descriptors.detach().numpy())


class FeatureTraining(Offset):
    """Turns its descriptors in every step: a map of other weights is of no use."""

    def __init__(self):
        super().__init__()
        self.net = LearnedSift()

    def on_train_batch_end(self, *batch):
        nn.init.orthogonal_(self.net.layer.weight)


def test_the_config_captures_with_the_features_of_the_weights_in_training(tmp_path):
    for folder in ("localization", "pipelines"):
        sys.path.append(str(Path(__file__).parents[1] / folder))
    from hps_walk import hps_recording
    from textured_room import CAMERA, looking, photo_poses, photograph, take_photos, textured_room

    (tmp_path / "scene").mkdir()
    mapper = PointMapper(textured_room(), 0.01)
    write_photos(take_photos(mapper, CAMERA, photo_poses(10), tmp_path / "scene"), tmp_path / "scene")
    write_ply(Ply(mapper.scan.points, None), tmp_path / "scene/pointcloud.ply")
    for number in range(6):
        pose = looking((2.0 + 0.05 * number, 2.0, 1.6), 0.3 + 0.02 * number, 0.1)
        Image.fromarray(photograph(mapper, CAMERA, pose)).save(tmp_path / f"{number}.png")
    walk = hps_recording(seconds=2.0)
    assert walk.camera is not None
    files = tuple(f"{number}.png" for number in range(6))
    stream = replace(walk.camera, timestamps=walk.camera.timestamps[:6], camera=CAMERA, image_files=files)
    store = RecordingStore(tmp_path)
    store.add(replace(walk, camera=stream, localization=None), split="val", config_hash="x")

    given = ["callbacks=localizer", f"callbacks.hps.localizer.scene={tmp_path}/scene", f"paths.run={tmp_path}/run"]
    given += [f"callbacks.hps.recordings=[{tmp_path}/walk]", "callbacks.hps.every_n_epochs=1"]
    given += ["+callbacks.hps.localizer.every=2", "callbacks.hps.pipeline.solver.settings.iterations=2"]
    callback = instantiate(compose("train", given).callbacks.hps, _convert_="all")
    assert isinstance(callback, HpsValidation)
    logged = []

    class Watch(lightning.Callback):
        def on_validation_end(self, trainer, pl_module):
            logged.append({name: value.item() for name, value in trainer.callback_metrics.items()})

    lightning.Trainer(
        accelerator="cpu",
        max_epochs=2,
        callbacks=[callback, Watch()],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    ).fit(FeatureTraining())
    assert [epoch["hps/localized_share"] for epoch in logged] == [1.0, 1.0], "each map is of its epoch's weights"
    assert all(epoch["hps/world_root_cm"] > 0 for epoch in logged)


def test_a_model_without_features_is_named(tmp_path):
    module = Offset()
    module.net = nn.Linear(1, 1)
    with pytest.raises(WearcapError, match="Offset extracts no features"):
        TrainedFeatures(str(tmp_path), str(tmp_path / "map.safetensors"))(module)
