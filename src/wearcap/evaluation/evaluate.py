"""Scores of a system on whole, uncut recordings over several seeds, and FID and Diversity of its motions (thesis §6.4;
Guo et al. 2020)."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.data.motion_features import MotionFeatures, Movement
from wearcap.errors import WearcapError
from wearcap.metrics.distribution import diversity, frechet_distance
from wearcap.metrics.scores import comparable
from wearcap.metrics.table import Row, Summary, summarize
from wearcap.models.checkpoint import load_trained
from wearcap.models.motion_autoencoder import MotionAutoencoder
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.runtime.system import CaptureInput, StageOptions, System

Measure = Callable[[Motion, CaptureInput, int], Row]
"""Function that scores a captured motion against its recording, given the seed."""
MIN_WINDOWS = 2000
"""Fewest windows that FID and Diversity are computed from."""
ENCODED_AT_ONCE = 512


def evaluate(
    system: System,
    store: RecordingStore,
    names: Iterable[str],
    seeds: Sequence[int],
    batch_size: int = 16,
    measure: Measure | None = None,
    scene: str | Path | None = None,
    metres_per_unit: float | None = None,
    options: StageOptions | None = None,
) -> Iterator[Row]:
    """Capture every recording with every seed and score it.

    `batch_size` recordings share a batch; `measure` replaces `system.score`; `scene` replaces the recordings' own.
    Raises WearcapError when a recording has no true motion.
    """
    names = sorted(names, key=lambda name: store.entries[name].frames)
    jobs = [(name, seed) for name in names for seed in seeds]
    for start in range(0, len(jobs), batch_size):
        batch = jobs[start : start + batch_size]
        recordings = {name: store.load(name) for name, _ in batch}
        sources = {
            name: CaptureInput.in_dataset(recording, store.root, scene, metres_per_unit)
            for name, recording in recordings.items()
        }
        captures = system.capture([sources[name] for name, _ in batch], [seed for _, seed in batch], options)
        for (name, seed), captured in zip(batch, captures):
            if captured.motion is not None:
                yield (measure or system.score)(captured.motion, sources[name], seed)


class Realism:
    """Collects latent vectors of captured and true windows in a motion autoencoder, by method and seed.

    Windows are `stride_s` apart and within one recording; captures are anchored to the true head, as for position
    errors, and use the same floor as the ground truth.
    """

    def __init__(self, net: MotionAutoencoder, features: MotionFeatures, stride_s: float = 1.0):
        self.net, self.features = net.eval(), features
        self.stride = round(stride_s * features.fps / features.every)
        self._true: dict[tuple[str, int], tuple[Tensor, Tensor]] = {}
        self._seen: defaultdict[str, dict[int, dict[str, tuple[Tensor, Tensor]]]]
        self._seen = defaultdict(lambda: defaultdict(dict))

    @classmethod
    def load(cls, checkpoint: str | Path, stride_s: float = 1.0) -> "Realism":
        """The collector in the latent space of a checkpoint of experiment=motion_autoencoder. Raises
        WearcapError for others."""
        module: Any = load_trained(checkpoint)[0]
        if not isinstance(module.net, MotionAutoencoder):
            expected = "a checkpoint of experiment=motion_autoencoder"
            raise WearcapError("realism needs a motion autoencoder", where=checkpoint, expected=expected)
        return cls(module.net, module.features, stride_s)

    def beside(self, measure: Measure, method: str) -> Measure:
        """A measure that also adds every motion it scores to the distribution of `method`."""

        def both(motion: Motion, source: CaptureInput, seed: int) -> Row:
            self.add(motion, source.recording, source.recording.name, seed, method)
            return measure(motion, source, seed)

        return both

    def add(self, motion: Motion, recording: Recording, name: str, seed: int, method: str) -> None:
        """Add one capture. Raises WearcapError as `score` does, and for another frame rate than the network's."""
        anchored, truth, _ = comparable(motion, recording, name)
        key = (name, len(truth))
        if key not in self._true:
            whole = self.features.movement(truth)
            self._true[key] = whole.floor_height, self._encode(whole)
        floor_height, latent_true = self._true[key]
        latent = self._encode(self.features.movement(anchored, floor_height))
        self._seen[method][seed][name] = latent, latent_true

    @torch.inference_mode()
    def _encode(self, whole: Movement) -> Float[Tensor, "window latent"]:
        windows = whole.windows(self.net.frames, self.stride)
        latents = [torch.zeros(0, self.net.latent)]
        for start in range(0, len(windows.joints), ENCODED_AT_ONCE):
            part = Movement(*(field[start : start + ENCODED_AT_ONCE] for field in windows))
            latents.append(self.net.encode(self.features.encode(part)))
        return torch.cat(latents)

    def windows(self, method: str) -> int:
        """Smallest number of a method's windows over its seeds."""
        return min((len(self._sets(method, seed)[0]) for seed in self._seen[method]), default=0)

    def _sets(self, method: str, seed: int) -> tuple[Tensor, Tensor]:
        """Latent vectors of all captured and of all true windows, in the order of the recordings' names."""
        pairs = [pair for _, pair in sorted(self._seen[method][seed].items())]
        return torch.cat([latent for latent, _ in pairs]), torch.cat([true for _, true in pairs])

    def scores(self, method: str) -> dict[str, Summary]:
        """`fid`, `diversity` and `truth_diversity` over seeds; NaN with fewer than `MIN_WINDOWS` windows."""
        values: dict[str, list[float]] = {"fid": [], "diversity": [], "truth_diversity": []}
        enough = self.windows(method) >= MIN_WINDOWS
        for seed in self._seen[method]:
            captured, true = self._sets(method, seed)
            found = (frechet_distance(captured, true), diversity(captured), diversity(true)) if enough else ()
            for name, value in zip(values, found or [math.nan] * 3):
                values[name].append(float(value))
        return {name: summarize(per_seed) for name, per_seed in values.items()}

    def notice(self, method: str) -> str | None:
        """An explanation of NaN scores, or None if there are enough windows."""
        found = self.windows(method)
        if found >= MIN_WINDOWS:
            return None
        return f"{method}: {found} windows are too few for FID and Diversity (at least {MIN_WINDOWS})"
