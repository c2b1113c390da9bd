"""Validation of a localiser in training by the motion that HPS captures with its current weights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import lightning
import torch
from lightning.pytorch import Callback

from wearcap.body.anny_body import anny_body
from wearcap.errors import WearcapError
from wearcap.io.formats.scene_folder import read_scene
from wearcap.localization.features import Extractor
from wearcap.localization.map_builder import MapSettings, build_map
from wearcap.metrics.scores import score
from wearcap.metrics.surface import foot_surface, foot_vertices
from wearcap.recording.store import dataset_folder, load_recording
from wearcap.runtime.system import CaptureInput
from wearcap.systems.hps.camera import Localize, MapLocalization
from wearcap.systems.hps.pipeline import HPS


@dataclass(frozen=True)
class TrainedFeatures:
    """Localisation by the features of a module in training, in a map of the scene that is built with the same weights."""

    scene: str
    """Folder of the scene: its scan and photos, or a COLMAP model."""
    file: str
    """File of that map."""
    every: int | None = None
    """Step between localised frames; None: as `MapLocalization` chooses."""
    settings: MapSettings = field(default_factory=MapSettings)

    def __call__(self, module: lightning.LightningModule) -> MapLocalization:
        """Raises WearcapError for a scene that cannot be read, and for a module whose `net` extracts no features."""
        extractor = module.get_submodule("net")
        if not isinstance(extractor, Extractor):
            expected = "a model whose `net` is a localization.features.Extractor"
            raise WearcapError(f"{type(module).__name__} extracts no features", expected=expected)
        photos, source = read_scene(self.scene)
        build_map(photos, source, extractor, settings=self.settings).save(self.file)
        return MapLocalization(extractor, map=self.file, every=self.every)


class HpsValidation(Callback):
    """Captures recordings with HPS every n-th validation epoch; logs root error, foot-to-scan distance, localised
    share.

    HPS has no network of its own: `localizer` builds its localisation step from the module in training, such as
    `TrainedFeatures`. It must come before the weight averaging in the list of callbacks, to see the averaged weights.
    """

    def __init__(
        self,
        pipeline: HPS,
        localizer: Callable[[lightning.LightningModule], Localize],
        recordings: Sequence[str],
        every_n_epochs: int = 1,
    ):
        """`recordings`: DATASET/NAME each, with a suit and a head camera."""
        self.pipeline, self.localizer = pipeline, localizer
        self.recordings, self.every_n_epochs = tuple(recordings), every_n_epochs
        self._epochs = 0

    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        self._epochs += 1
        if self._epochs % self.every_n_epochs:
            return
        training = pl_module.training
        pl_module.eval()
        with torch.no_grad():
            pipeline = replace(self.pipeline, localization=self.localizer(pl_module))
            rows = [validated(pipeline, where) for where in self.recordings]
        pl_module.train(training)
        for name in rows[0]:
            scored = [row[name] for row in rows if row[name] == row[name]]
            pl_module.log(f"hps/{name}", sum(scored) / len(scored) if scored else float("nan"), rank_zero_only=True)


def validated(pipeline: HPS, where: str) -> dict[str, float]:
    """Scores of one recording by name with unit; NaN for those whose ground truth or scan is missing."""
    recording, folder = load_recording(where), dataset_folder(where)
    source = CaptureInput.in_dataset(recording, folder)
    results = pipeline.results(source)
    motion, nan = pipeline.motion_of(results), float("nan")
    assert motion is not None
    scan, feet = source.read_scan(), {"surface_cm": nan, "sliding_cm": nan}
    if scan is not None and motion.contact_prob is not None:
        # Distance to the scan and sliding of the feet that the suit reports in contact (thesis Table 4.3).
        body = anny_body(motion.skeleton, recording.shape or None)
        points, touching = foot_vertices(body, motion.T_world_joint, motion.contact_prob >= 0.5)
        found = foot_surface(points, touching, scan.surface)
        feet = {"surface_cm": found.distance_cm, "sliding_cm": found.sliding_cm}
    scores = score(motion, recording, where, 0).scores if recording.motion is not None else {}
    return {
        "world_root_cm": scores.get("world_root_cm", nan),
        "world_mpjpe_cm": scores.get("world_mpjpe_cm", nan),
        **feet,
        "localized_share": (results["localize"].confidence > 0).double().mean().item(),
    }
