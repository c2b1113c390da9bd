"""`wearcap prepare SOURCE`: make a data set of recordings."""

import sys
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from data_prep.shared.engine import Report, Splits, prepare
from wearcap.checks import require_sound
from wearcap.checks.truth import of_person, people
from wearcap.cli.conf import compose, explained, require_writable, splits_dir
from wearcap.cli.verbs import sources
from wearcap.errors import WearcapError, nearest
from wearcap.recording.store import SPLITS, RecordingStore


def run(config: DictConfig) -> Report:
    """Run the config's preparation: recordings by `tasks`, or by `rework` a change of an existing data set."""
    if "rework" in config:
        if "output" not in config.rework and Path(config.output) != Path(config.dataset):
            what = f"output={config.output}, but this source rewrites the recordings of its data set"
            raise WearcapError(what, where=config.dataset, fix="Leave output=… out, or copy the data set first.")
        report = instantiate(config.rework, _convert_="all")
    else:
        listed = splits_dir() / config.splits
        splits = Splits.read(listed if listed.is_file() else Path(config.splits))
        tasks = instantiate(config.tasks, _convert_="all", _partial_=True)(splits=splits)
        options = {key: config[key] for key in ("jobs", "backend", "scheduler", "overwrite")}
        inspect = require_sound if config.check else None
        report = prepare(tasks, config.output, **options, inspect=inspect)
    _show_report(report, RecordingStore.open(config.output))
    return report


def _show_report(report: Report, store: RecordingStore) -> None:
    for name, note in sorted(report.notes.items()):
        print(f"{name}: {note}")
    for name, reason in sorted(report.failed.items()):
        print(f"failed: {name}: {reason}", file=sys.stderr)
    ours = {*report.written, *report.current}
    if others := [name for name in store.names() if name not in ours]:
        print(f"{len(others)} recordings of earlier runs lie here too, {others[0]} among them")
    print(f"{store.root}: {len(report.written)} written, {len(report.current)} current, {len(report.failed)} failed")
    for split in SPLITS:
        entries = [store.entries[name] for name in store.names(split)]
        minutes = sum(entry.duration_s for entry in entries) / 60
        subjects = len({entry.context.subject for entry in entries})
        print(f"  {split:5} {len(entries):4} recordings, {subjects:3} subjects, {minutes:7.1f} min")
    fresh = {store.entries[name].context.subject for name in report.written}
    names = sorted(name for name in ours if store.entries[name].context.subject in fresh)
    for subject, person in people(store, names).items():
        if wrong := [f"{finding.what} ({finding.evidence})" for finding in of_person(person)]:
            print(f"warning: person {subject}: {'; '.join(wrong)}")


def main(arguments: list[str]) -> None:
    """Exits with 1 when a recording could not be made."""
    source = next((argument for argument in arguments if "=" not in argument and argument[0] != "-"), None)
    if source is None:
        raise WearcapError("no source given", expected=f"one of {', '.join(sources())}")
    if source not in sources():
        raise WearcapError(f"no source {source!r}", fix=nearest(source, sources()))
    overrides = [f"prepare={source}", *(argument for argument in arguments if argument != source)]
    with explained("prepare", overrides):
        config = compose("prepare", overrides)
        OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # a missing value raises here
        require_writable(config.output, "output")
        report = run(config)
    if report.failed:
        sys.exit(1)
