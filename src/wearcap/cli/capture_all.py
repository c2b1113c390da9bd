"""`wearcap capture recording=DATASET`: all recordings of a data set, or of one of its splits."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich import print as show

from wearcap.cli.conf import load_pipeline, parallel_of
from wearcap.errors import WearcapError
from wearcap.evaluation.datasets import (
    Outcome,
    loaded,
    outcome_table,
    over_recordings,
    require_all,
    settings_key,
    write_outcomes,
)
from wearcap.parallel import reason_of
from wearcap.recording import Motion, RecordingStore
from wearcap.recording.store import MANIFEST
from wearcap.runtime.system import CaptureInput, System

Capture = Callable[[Any, System], Motion | None]
"""Captures the one recording of a config and writes its files. The config's values are plain: names of recordings, in
which OmegaConf would resolve `${…}`, are no values of its own."""

WITHOUT_EFFECT = (
    *("recording", "split", "output", "jobs", "backend", "scheduler", "overwrite", "paths", "cache", "live", "check"),
)
"""Settings that do not change what is captured of a recording."""


def is_dataset(config: DictConfig) -> bool:
    """Whether the recording of a config is a data set of several, or a split of one is asked for."""
    folder = Path(config.recording)
    if config.live or not (folder / MANIFEST).is_file():
        return False
    return config.split is not None or len(RecordingStore.open(folder).names()) != 1


def capture_all(config: DictConfig, capture: Capture) -> None:
    """Capture a data set into a folder per recording; shows a table of them, and writes it as recordings.csv.

    Recordings that are finished are skipped. Raises WearcapError at the end when some failed.
    """
    store, output = RecordingStore.open(config.recording), Path(config.output)
    names = store.names(config.split)
    if not names:
        what = f"no recordings{f' of split {config.split}' if config.split else ''}"
        raise WearcapError(what, store.root, fix="Choose another split, or leave it out.")
    load_pipeline(config.checkpoint, config.pipeline, config.device, shared=True)  # settings are complained about once
    plain: Any = OmegaConf.to_container(config, resolve=True)
    settings = {key: value for key, value in plain.items() if key not in WITHOUT_EFFECT}
    given = plain["checkpoint"] or []
    key = settings_key(settings, given if isinstance(given, list) else [given], "wearcap.cli.capture")
    outcomes = list(
        over_recordings(
            partial(_captured, plain=plain, key=key, capture=capture),
            store,
            names,
            parallel_of(config),
            notes=output / "finished",
            settings=key,
            scene=config.scene,
            overwrite=config.overwrite,
        )
    )
    write_outcomes(output / "recordings.csv", outcomes)
    show(outcome_table(f"{store.root.name}: {len(outcomes)} recordings", outcomes))
    show(f"motions: {output}")
    require_all(outcomes, output)


def _captured(names: Sequence[str], plain: dict[str, Any], key: str, capture: Capture) -> list[Outcome]:
    """In a worker: capture one recording, and score it where its true motion is known."""
    (name,) = names
    folder, root = Path(plain["output"]) / name, Path(plain["recording"])
    config = SimpleNamespace(**plain | {"recording": str(root / name), "output": str(folder)})
    system = loaded(key, partial(load_pipeline, config.checkpoint, config.pipeline, config.device, shared=True))
    begin = time.perf_counter()
    motion = capture(config, system)
    seconds = time.perf_counter() - begin
    store, rows, error = RecordingStore.open(root), [], ""
    recording = store.load(name)
    if motion is not None and recording.motion is not None:
        source = CaptureInput.in_dataset(recording, root, config.scene, config.metres_per_unit)
        try:
            rows = [system.score(motion, source, config.seed)]
        except WearcapError as refused:
            error = f"captured, but not scored: {reason_of(refused)}"
    files = [(str(path), path.stat().st_size) for path in sorted(folder.iterdir()) if path.is_file()]
    entry = store.entries[name]
    frames = entry.frames if motion is None else len(motion)
    return [Outcome(name, seconds, frames, tuple(rows), tuple(files), error, entry.context.activity)]
