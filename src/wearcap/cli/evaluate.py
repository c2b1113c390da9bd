"""`wearcap evaluate`: whole recordings of a split, over seeds, beside the trivial baselines."""

from collections.abc import Iterable
from pathlib import Path

from omegaconf import DictConfig, ListConfig
from rich import print as show
from rich.progress import Progress

from wearcap.cli.conf import hydra_main, load_systems, trained_on, with_pipeline
from wearcap.errors import WearcapError
from wearcap.evaluation.baselines import BASELINES
from wearcap.evaluation.evaluate import Realism, evaluate
from wearcap.metrics.table import Row, Scores, Summary, aggregate, rich_table, write_scores
from wearcap.recording import RecordingStore
from wearcap.runtime.system import StageOptions, System

OURS = "wearcap"
"""Name of the evaluated checkpoint's method in the table."""

HELP = "score a checkpoint: wearcap evaluate checkpoint=… [dataset=DIR] [split=test], or pipeline=hps dataset=DIR"


def run(config: DictConfig) -> Scores:
    """Evaluate the checkpoint(s) and baselines, or a pipeline that needs none; prints and saves the table."""
    given = config.checkpoint
    checkpoints = [str(path) for path in given] if isinstance(given, ListConfig) else [given] if given else []
    systems = load_systems(checkpoints, config.pipeline, config.device)
    baselines = systems[0].baselines if config.baselines else ()
    sources, validated = [], None
    if checkpoints and (baselines or not config.dataset) and not systems[0].joins_checkpoints:
        sources, validated = trained_on(checkpoints[0])
    if config.dataset is None and validated is None:
        raise WearcapError("dataset has no value", fix="Give it on the command line: dataset=DIR.")
    store = RecordingStore.open(config.dataset or validated)
    name = OURS if systems[0].draws else systems[0].name
    realism = None if config.realism is None else Realism.load(config.realism)
    scores: Scores = {}
    with Progress(transient=True) as progress:

        def scored(system: System, seeds: list[int], title: str, method: str) -> Iterable[Row]:
            names = store.names(config.split)
            measure = system.score if realism is None else realism.beside(system.score, method)
            options = StageOptions(None if config.cache is None else Path(config.cache), console=progress.console)
            place = config.scene, config.metres_per_unit
            found = evaluate(system, store, names, seeds, config.batch_size, measure, *place, options)
            return progress.track(found, total=len(names) * len(seeds), description=title)

        rows: list[Row] = []
        for index, system in enumerate(systems):
            seeds = [index * 1000 + seed for seed in config.seeds] if system.draws else list(config.seeds)[:1]
            title = Path(checkpoints[index]).parts[-3:][0] if name == OURS else name
            rows += scored(system, seeds, title, name)
        scores[name] = _summaries(rows, realism, name)
        for label in baselines:
            baseline = BASELINES[label].fit([RecordingStore.open(source) for source in sources])
            rows = list(scored(baseline, [0], label, label))
            scores[label] = _summaries(rows, realism, label)
    about = {"dataset": str(store.root), "split": config.split, "checkpoint": ", ".join(checkpoints) or "None"}
    show(rich_table(f"{store.root.name}, {config.split} split", scores))
    write_scores(config.output, scores, about)
    show(f"table: {config.output}")
    return scores


def _summaries(rows: list[Row], realism: Realism | None, method: str) -> dict[str, Summary]:
    """A method's scores, with FID and Diversity of its motions if configured."""
    if realism is None:
        return aggregate(rows)
    if notice := realism.notice(method):
        show(f"[yellow]{notice}[/yellow]")
    return aggregate(rows) | realism.scores(method)


def main(arguments: list[str]) -> None:
    hydra_main("evaluate", run, with_pipeline(arguments))
