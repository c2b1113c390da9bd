"""`wearcap adapt`: a checkpoint goes on training on one wearer's motion, as far as that helps on what is held out."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from rich import print as show
from torch import Tensor

from data_prep.shared.mocap import MOCAP, About, mocap_recording
from wearcap.body.skeletons import xsens23
from wearcap.cli.conf import compose, hydra_main, load_pipeline
from wearcap.cli.stated import stated
from wearcap.cli.train import train
from wearcap.errors import WearcapError
from wearcap.evaluation.evaluate import evaluate
from wearcap.io.conventions import Conventions
from wearcap.metrics.table import aggregate
from wearcap.models.checkpoint import read_checkpoint, share_checkpoint
from wearcap.reading.any_file import sources
from wearcap.recording import Recording, RecordingStore
from wearcap.recording.store import MANIFEST
from wearcap.recording.timing import between_seconds
from wearcap.runtime.stages import digest
from wearcap.runtime.system import LearnedSystem, System, training_of
from wearcap.training.run import last_checkpoint

PIECE_S = 5.0
"""Least length (s) of both pieces of a recording that is cut where the held-out part begins; HMD²'s windows are 4 s."""
WEARER = "wearer"


def run(config: DictConfig) -> float:
    """Adapt the config's checkpoint and write it; returns its main error on the held-out motion.

    Raises WearcapError for what cannot be adapted, and where nothing was gained: then nothing is written.
    """
    (training, system), output = training_of(config.checkpoint), Path(config.output)
    if system is None or not issubclass(system, LearnedSystem):
        expected = "a checkpoint of HMD², MocapEvery or ECHO"
        raise WearcapError(f"{training} is not adapted to wearers", config.checkpoint, expected)
    if output.suffix != ".safetensors":
        raise WearcapError(f"output={output}", expected="NAME.safetensors")
    paths = config.recordings if isinstance(config.recordings, ListConfig) else [config.recordings]
    recordings = [each for path in paths for each in true_recordings(Path(path), stated(config))]
    require_one_wearer(recordings, config.least_s, config.similar)
    folder = Path(config.paths.run)
    store = _data_set(folder / WEARER, *parted(recordings, config.held_out))
    composed = _training(config, system, store, folder)
    others = [name for name, source in composed.data.sources.items() if source and name != WEARER]
    show(f"the wearer's windows are mixed with those of: {', '.join(others) or 'nothing, for none of it is here'}")
    train(composed)
    pipeline = compose("evaluate", [f"pipeline={system.pipeline}"]).pipeline
    trained, errors = last_checkpoint(folder), dict[Path, float]()
    before, after = (read_checkpoint(each)[1] for each in (config.checkpoint, trained))
    for distance in (0.0, *config.distances):
        candidate = folder / f"{distance:g}.safetensors"
        share_checkpoint(trained, candidate, changed=between(before, after, distance))
        adapted = load_pipeline(candidate, pipeline, config.device)
        scores = aggregate(list(evaluate(adapted, store, store.names("val"), [0])))
        metric, summary = next(iter(scores.items()))  # the main error
        errors[candidate] = summary.mean
        show(f"{metric} on the held-out part, {distance:.0%} of the way: {errors[candidate]:.2f}")
    first, best = errors[folder / "0.safetensors"], min(errors, key=errors.__getitem__)
    if not errors[best] < first:
        what = f"nothing was gained on the held-out part ({metric} {first:.2f} before), and nothing is written"
        raise WearcapError(what, config.checkpoint, fix="Give more motion of the wearer, or keep the checkpoint.")
    share_checkpoint(best, output)
    show(f"checkpoint: {output}, {metric} {first:.2f} before, {errors[best]:.2f} after")
    return errors[best]


def between(before: dict[str, Tensor], after: dict[str, Tensor], share: float) -> dict[str, Tensor]:
    """Weights that lie a share of the way from one training's to those that it went on to (Wortsman et al. 2022)."""
    both = [name for name, value in after.items() if name in before and value.is_floating_point()]
    return {name: torch.lerp(before[name], after[name], share) for name in both}


def true_recordings(path: Path, how: Conventions) -> list[Recording]:
    """The recordings of a path with true motion at 60 Hz, on `xsens23` of the wearer's own bones, and a device on the head.

    Prepared ones stay as they are; of a suit's or a file's motion, head, floor and contacts are derived. Raises
    WearcapError for what cannot be read, has no true motion, or has limbs that are not recognised.
    """
    found = []
    for name, load in sources(path, how).items():
        recording = load().recording
        motion, head = recording.motion or recording.suit, recording.head
        if motion is None or len(motion) < 2:
            expected = "motion of a suit (MVNX) or of motion capture (BVH), or a prepared recording with true motion"
            raise WearcapError(f"recording {name!r} has no true motion", path, expected)
        ready = recording.motion is not None and head is not None and len(head.timestamps) == len(motion)
        if not ready or motion.skeleton.joint_names != xsens23().joint_names or abs(motion.fps - MOCAP.fps) > 0.5:
            about = About(recording.name, recording.subject, recording.source, recording.license, recording.activity)
            recording = mocap_recording(motion, about, MOCAP)
        found.append(recording)
    return found


def require_one_wearer(recordings: list[Recording], least_s: float, similar: float) -> None:
    """Raise WearcapError for less motion than `least_s` (s), and for heads whose heights differ by more than `similar`."""
    if (found := sum(each.duration_s for each in recordings)) < least_s:
        what, fix = f"{found:.0f} s of motion are too little", "About two minutes of varied activity do well."
        raise WearcapError(what, expected=f"{least_s:g} s at least", fix=fix)
    statures = {each.motion.skeleton.height_of("head"): each.name for each in recordings if each.motion}
    if max(statures) > (1 + similar) * min(statures):
        apart = sorted(statures)[:: len(statures) - 1]
        what = "; ".join(f"the head is {each:.2f} m high in {statures[each]}" for each in apart)
        raise WearcapError(f"recordings on several people's skeletons: {what}", expected="recordings of one wearer")


def parted(recordings: list[Recording], held_out: float) -> tuple[list[Recording], list[Recording]]:
    """Recordings to learn from, and the last ones, about `held_out` of the time; a long one between is cut."""
    learnt, kept, left = [], [], (1 - held_out) * sum(each.duration_s for each in recordings)
    for each in recordings:
        length = each.duration_s
        if min(left, length - left) >= PIECE_S:
            learnt.append(between_seconds(each, 0, left))
            kept.append(between_seconds(each, left, length + 1))
        else:
            (learnt if left >= length / 2 or not learnt else kept).append(each)
        left -= length
    return learnt, kept


def _data_set(folder: Path, learnt: list[Recording], held_out: list[Recording]) -> RecordingStore:
    """The wearer's data set, in the order of the recordings. Raises WearcapError where nothing is held out."""
    if not held_out:
        fix = "Give further recordings, or held_out=0.4."
        raise WearcapError("nothing is held out of a recording as short as this", fix=fix)
    shutil.rmtree(folder, ignore_errors=True)
    store = RecordingStore(folder)
    for split, recordings in (("train", learnt), ("val", held_out)):
        for number, each in enumerate(recordings):
            named = replace(each, name=f"{split}_{number:03}_{each.name}", scene=None, environment=None, camera=None)
            store.add(named, split=split, config_hash="")
    return store


def _training(config: DictConfig, system: type[System], store: RecordingStore, folder: Path) -> DictConfig:
    """The training of the checkpoint's system, from its weights, with the wearer's windows among its own."""
    about, _ = read_checkpoint(config.checkpoint)
    model, own = about["model"], about.get("data") or {}
    base: Any = compose("train", [str(system.experiment), "callbacks=averaged"])
    OmegaConf.set_struct(base, False)
    base.name = about.get("name", base.name)
    base.data = own if "dataset" in own else base.data  # of a run's own checkpoint: what it was trained on, and how
    changes: Any = OmegaConf.to_container(config.train, resolve=True)
    base.optimizer = changes.pop("optimizer")  # in place of the training's own, which may be of another kind
    base.merge_with(changes)
    base.model = model | {"optimization": base.optimizer}
    base.init, base.paths = config.checkpoint, {**config.paths, "run": str(folder)}
    base.wearer = {"recordings": digest(sorted(each.sha256 for each in store.entries.values()))}
    data: Any = base.data
    content: Any = OmegaConf.to_container(data.dataset.content, resolve=True)
    if "conditions" in content:
        # In the model's order; embeddings, which no recording needs to have, as it takes them
        windows = content["conditions"]
        content["conditions"] = {name: windows[name] for name in model["conditions"]}
        for name, each in model["conditions"].items():
            windows[name] |= {key: each[key] for key in ("encoder", "size") if "size" in each}
        base.surroundings = {}
    data.dataset.content = content
    # The last step, too, is followed by a validation, which leaves a checkpoint.
    loading, validations = data.loading, -(-config.steps // data.loading.steps_per_epoch)
    loading.steps_per_epoch = -(-config.steps // validations)
    base.trainer.max_steps = validations * loading.steps_per_epoch
    here = {name: each for name, each in data.sources.items() if each and (Path(each.root) / MANIFEST).is_file()}
    total = sum(each.weight for each in here.values())
    for each in here.values():
        each.weight *= (1 - config.share) / total
    wearer = {"root": str(store.root), "weight": config.share, "bodies": False}
    data.sources, data.val_sources = here | {WEARER: wearer}, {WEARER: wearer}
    return base


def main(arguments: list[str]) -> None:
    hydra_main("adapt", run, arguments)
