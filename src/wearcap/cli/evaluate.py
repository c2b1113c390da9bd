"""`wearcap evaluate`: whole recordings of a split, over seeds, beside the trivial baselines."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from rich import get_console
from rich import print as show

from wearcap.apps.viewer.picture import contact_sheet, save_png
from wearcap.apps.viewer.shown import with_objects
from wearcap.cli.conf import (
    hydra_application,
    load_systems,
    parallel_of,
    run_application,
    sampling,
    trained_on,
    with_pipeline,
)
from wearcap.cli.stated import stated
from wearcap.errors import WearcapError
from wearcap.evaluation.baselines import BASELINES
from wearcap.evaluation.breakdown import (
    activity_table,
    by_activity,
    by_posture,
    error_columns,
    extremes,
    main_errors,
    mostly_done,
    part_table,
    posture_table,
    recording_table,
)
from wearcap.evaluation.datasets import (
    Outcome,
    failures,
    loaded,
    outcome_table,
    over_recordings,
    require_all,
    rows_of,
    scored,
    settings_key,
    write_outcomes,
)
from wearcap.evaluation.evaluate import Realism
from wearcap.evaluation.samples import best_samples
from wearcap.metrics.table import Row, Scores, Summary, aggregate, rich_table, write_scores
from wearcap.parallel import Parallel
from wearcap.prepare.files import with_own_files
from wearcap.reading import read
from wearcap.recording import RecordingStore
from wearcap.recording.store import MANIFEST, dataset_folder
from wearcap.runtime.system import CaptureInput, System

OURS = "wearcap"
"""Name of the evaluated checkpoint's method in the table."""


LISTED = 30
"""Most recordings that are shown one by one, if none failed; table.csv has them all."""

CAPTURING = ("pipeline", "scene", "metres_per_unit", "batch_size", "device")
"""Settings on which scores depend, beside checkpoint and seeds."""


def run(config: DictConfig) -> Scores:
    """Evaluate the checkpoint(s) and baselines, or a pipeline that needs none; shows and saves the table.

    Raises WearcapError when no recording could be scored, and after the table of the others when some could not.
    """
    given = config.checkpoint
    checkpoints = [str(path) for path in given] if isinstance(given, ListConfig) else [given] if given else []
    systems = load_systems(checkpoints, config.pipeline, config.device)
    store, names = _chosen(config, checkpoints, systems[0])
    realism = None if config.realism is None else Realism.load(config.realism)
    scoring = _Scoring(config, store, names, realism)
    name = OURS if systems[0].draws else systems[0].name
    outcomes: list[Outcome] = []
    together = [checkpoints] if len(systems) == 1 else [[checkpoint] for checkpoint in checkpoints]
    for index, (system, own) in enumerate(zip(systems, together)):
        seeds = [index * 1000 + seed for seed in config.seeds] if system.draws else list(config.seeds)[:1]
        outcomes += scoring.of(system, own, seeds, f"{name}-{index}" if index else name, name)
    failed = failures(outcomes)
    rows = rows_of(outcomes, failed)
    if not rows:
        require_all(outcomes, store.root)
        raise WearcapError(f"no recordings of split {config.split}", store.root, fix="Choose another split.")
    of_method = {name: rows}
    if config.samples > 1:
        best = f"best of {config.samples} samples"
        drawn = scoring.of(sampling(systems[0]), together[0], range(config.samples), best, best, sampled=True)
        require_all(drawn, store.root)
        of_method[best] = best_samples(rows_of(drawn))
    if config.baselines and systems[0].baselines:
        of_method |= _baselines(scoring, systems[0].baselines, checkpoints[0], {row.recording for row in rows})
    scores = {method: _summaries(found, realism, method) for method, found in of_method.items()}
    activities = {method: by_activity(found, scoring.activity_of) for method, found in of_method.items()}
    about = {"dataset": str(store.root), "split": config.split, "checkpoint": ", ".join(checkpoints) or "None"}
    if len(outcomes) <= LISTED or failed:
        show(outcome_table(f"{name}, {len(outcomes)} recordings", outcomes))
    show(rich_table(f"{store.root.name}, {config.split} split", scores))
    _show_where(name, rows, scores, activities[name], scoring.activity_of)
    places = extremes(main_errors(rows))
    of_postures = {method: by_posture(found)[0] for method, found in of_method.items()}
    write_scores(config.output, scores, about, _errors(activities), places, of_postures)
    write_outcomes(Path(config.output).with_suffix(".csv"), outcomes)
    show(f"table: {config.output}")
    if config.sheets:
        for place, recording in places.items():
            show(f"{place}: {_sheet(systems[0], store, recording, place, config)}")
    require_all(outcomes, store.root)
    return scores


def _show_where(name: str, rows: list[Row], scores: Scores, activities: Scores, activity_of: Mapping[str, str]) -> None:
    """Tables of errors by part of the body, and, of several recordings, by activity and of the worst to the best."""
    show(part_table("by part of the body", scores))
    errors, shares = by_posture(rows)
    if errors:
        show(posture_table(f"{name} by posture (share of the frames)", errors, shares))
    recordings = {row.recording for row in rows}
    if len(recordings) > 1 and extremes(main_errors(rows)):
        counts = Counter(mostly_done(activity_of[recording]) for recording in recordings)
        show(activity_table(f"{name} by what was mostly done", activities, counts))
        show(recording_table(f"{name}: recordings", rows, activity_of))


def _errors(activities: Mapping[str, Scores]) -> dict[str, Scores]:
    """What is written by activity: the errors that are shown."""
    return {
        method: {
            activity: {metric: each[metric] for metric in error_columns(each)} for activity, each in scores.items()
        }
        for method, scores in activities.items()
    }


def _sheet(system: System, store: RecordingStore, name: str, place: str, config: DictConfig) -> Path:
    """Draw a recording's truth and its capture with the first seed beside each other, with their objects; returns the file."""
    recording, path = store.load(name), Path(config.output).with_name(f"{Path(config.output).stem}_{place}.png")
    source = CaptureInput.in_dataset(recording, store.root, config.scene, config.metres_per_unit)
    motion, environment = system.capture([source], [config.seeds[0]])[0].motion, system.objects(source)
    truth = with_objects(recording, environment)
    assert motion is not None
    assert truth is not None
    shown = {f"{name}, truth": truth, "captured": motion}
    save_png(path, contact_sheet(shown, environment=environment))
    return path


def _chosen(config: DictConfig, checkpoints: Sequence[str], system: System) -> tuple[RecordingStore, list[str]]:
    """The data set and its recordings that are scored: those of a split, or the one of `recording`; a file that belongs to
    no data set is put into one of its own beside the output. Raises WearcapError where there is no true motion."""
    if config.recording is None:
        store = RecordingStore.open(config.dataset or _validated(checkpoints, system))
        return store, store.names(config.split)
    recording, folder = read(config.recording, stated(config)), dataset_folder(config.recording)
    if recording.motion is None:
        expected = "a recording with a true motion beside its sensors"
        raise WearcapError("nothing to score against", config.recording, expected, "Capture it instead.")
    if not (folder / MANIFEST).is_file():
        origin, folder = folder, Path(config.output).parent / "recording"
        RecordingStore(folder).add(with_own_files(recording, folder, origin), split="test", config_hash="")
    return RecordingStore.open(folder), [recording.name]


def _validated(checkpoints: Sequence[str], system: System) -> str:
    """The data set that a checkpoint was validated on. Raises WearcapError where that is not one data set, or not here."""
    fix = "Give dataset=DIR, or recording=FILE."
    if not checkpoints or system.joins_checkpoints:
        raise WearcapError("dataset has no value", fix=fix)
    folder = trained_on(checkpoints[0])[1]
    if not (Path(folder) / MANIFEST).is_file():
        raise WearcapError("the data set that this checkpoint was validated on is not here", folder, fix=fix)
    return folder


class _Scoring:
    """Scores the recordings of an evaluation with one method after the other."""

    def __init__(self, config: DictConfig, store: RecordingStore, names: Sequence[str], realism: Realism | None):
        self.config, self.store, self.realism = config, store, realism
        self.names = sorted(names, key=lambda name: store.entries[name].frames)
        self.activity_of = {name: store.entries[name].context.activity for name in names}

    def of(
        self,
        system: System,
        checkpoints: Sequence[str],
        seeds: Sequence[int],
        title: str,
        method: str,
        sampled: bool = False,
    ) -> list[Outcome]:
        """Outcomes of a configured system, or of one that `sampling` made of it, whose workers load it by themselves."""
        values = {name: self.config[name] for name in CAPTURING}
        plain: dict[str, Any] = {
            name: OmegaConf.to_container(value, resolve=True) if isinstance(value, DictConfig) else value
            for name, value in values.items()
        }
        key = settings_key(plain | {"seeds": list(seeds), "sampled": sampled}, checkpoints)
        loaded(key, lambda: system)
        make = partial(_load, list(checkpoints), plain["pipeline"], self.config.device, sampled)
        return self.outcomes(self.names, system, make, key, seeds, title, method, parallel_of(self.config), sampled)

    def outcomes(
        self,
        names: Sequence[str],
        system: System,
        make: Callable[[], System],
        key: str,
        seeds: Sequence[int],
        title: str,
        method: str,
        how: Parallel,
        samples: bool = False,
    ) -> list[Outcome]:
        """Outcomes of a system that `make` makes; with `realism`, whose latents are kept here, in this process. `samples`: as of
        `scored`."""
        config, realism = self.config, self.realism
        chunk = max(1, config.batch_size // len(seeds)) if system.draws else 1
        measure = None if realism is None else realism.beside(system.score, method)
        work = partial(
            scored,
            system=make,
            key=key,
            root=self.store.root,
            seeds=list(seeds),
            batch_size=config.batch_size,
            scene=config.scene,
            metres_per_unit=config.metres_per_unit,
            cache=None if config.cache is None else Path(config.cache),
            check=config.check,
            measure=measure,
            samples=samples,
        )
        notes = Path(config.output).with_suffix(".finished") / title.replace(" ", "_")
        found = over_recordings(
            work,
            self.store,
            names,
            how if realism is None else Parallel(jobs=1),
            chunk=chunk,
            notes=notes if realism is None else None,
            settings=key,
            scene=config.scene,
            overwrite=config.overwrite,
        )
        return list(found)


def _load(checkpoints: list[str], pipeline: dict[str, Any], device: str, sampled: bool) -> System:
    system = load_systems(checkpoints, pipeline, device)[0]
    return sampling(system) if sampled else system


def _baselines(scoring: _Scoring, labels: Sequence[str], checkpoint: str, names: set[str]) -> dict[str, list[Row]]:
    """Rows of the baselines, on the recordings that were scored; a line says why one is left out."""
    found: dict[str, list[Row]] = {}
    turned_off = "baselines=false turns them off."
    try:
        stores = [RecordingStore.open(source) for source in trained_on(checkpoint)[0]]
    except WearcapError as error:
        what = f"left out: {', '.join(labels)}, which need the data that the checkpoint was trained on. {error}"
        _notice(f"{what} {turned_off}")
        return found
    for label in labels:
        try:
            baseline = BASELINES[label].fit(stores)
            key = settings_key({"baseline": label}, [], "wearcap.evaluation.baselines")
            key += "".join(entry.sha256 for store in stores for entry in store.entries.values())
            chosen = [name for name in scoring.names if name in names]
            outcomes = scoring.outcomes(
                chosen, baseline, lambda made=baseline: made, key, [0], label, label, Parallel(jobs=1)
            )
            require_all(outcomes, scoring.store.root)
            found[label] = rows_of(outcomes)
        except WearcapError as error:
            _notice(f"left out: {label}. {error} {turned_off}")
    return found


def _notice(text: str) -> None:
    get_console().print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)


def _summaries(rows: list[Row], realism: Realism | None, method: str) -> dict[str, Summary]:
    """A method's scores, with FID and Diversity of its motions if configured."""
    if realism is None:
        return aggregate(rows)
    if notice := realism.notice(method):
        show(f"[yellow]{notice}[/yellow]")
    return aggregate(rows) | realism.scores(method)


def main(arguments: list[str], application: Callable[[], Any] | None = None) -> None:
    run_application("evaluate", application or hydra_application("evaluate", run), with_pipeline(arguments))
