"""`wearcap evaluate`: whole recordings of a split, over seeds, beside the trivial baselines."""

from collections.abc import Iterable
from pathlib import Path

from omegaconf import DictConfig, ListConfig
from rich import print as show
from rich.progress import Progress

from wearcap.cli.conf import hydra_main
from wearcap.cli.load import LearnedPipeline, load_pipeline, load_realism, staged, trained_on
from wearcap.errors import WearcapError
from wearcap.evaluation.baselines import MeanPose, NearestWindow
from wearcap.evaluation.evaluate import Pipeline, evaluate
from wearcap.evaluation.realism import Realism
from wearcap.metrics.scores import Measure, score, score_in_world
from wearcap.metrics.table import Row, Scores, Summary, aggregate, rich_table, write_scores
from wearcap.recording import RecordingStore
from wearcap.systems.echo.dataset import EchoOnDataset
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.ireplica.pipeline import IReplica
from wearcap.systems.ireplica.scores import with_interactions
from wearcap.systems.mocap_every.pipeline import MocapEvery

OURS = "wearcap"
"""Name of the evaluated checkpoint's method in the table."""

HELP = "score a checkpoint: wearcap evaluate checkpoint=… [dataset=DIR] [split=test], or pipeline=hps dataset=DIR"


def run(config: DictConfig) -> Scores:
    """Evaluate the checkpoint(s) and baselines, or a pipeline that needs none; prints and saves the table."""
    given = config.checkpoint
    checkpoints = list(given) if isinstance(given, ListConfig) else [given]
    pipeline = load_pipeline(
        given if given is None else [str(path) for path in checkpoints], config.pipeline, config.device
    )
    with Progress(transient=True) as progress:
        if isinstance(pipeline, LearnedPipeline):
            store, scores = _learned(checkpoints, config, progress)
        else:
            if config.dataset is None:
                raise WearcapError("dataset has no value", fix="Give it on the command line: dataset=DIR.")
            store = RecordingStore.open(config.dataset)
            capture = staged(pipeline, config, store.root, progress.console)
            measure = with_interactions(pipeline, store.root) if isinstance(pipeline, IReplica) else score
            rows = _rows(capture, store, list(config.seeds)[:1], config, progress, pipeline.name, measure)
            scores = {pipeline.name: aggregate(list(rows))}
    about = {"dataset": str(store.root), "split": config.split, "checkpoint": ", ".join(map(str, checkpoints))}
    show(rich_table(f"{store.root.name}, {config.split} split", scores))
    write_scores(config.output, scores, about)
    show(f"table: {config.output}")
    return scores


def _learned(checkpoints: list[str], config: DictConfig, progress: Progress) -> tuple[RecordingStore, Scores]:
    """Evaluate checkpoints; returns the data set, and their scores beside the baselines'."""
    own_data = bool(config.dataset) and not config.baselines
    sources, validated = ([], None) if own_data else trained_on(checkpoints[0])
    store = RecordingStore.open(config.dataset or validated)
    realism = None if config.realism is None else load_realism(config.realism)
    rows: list[Row] = []
    for index, checkpoint in enumerate(checkpoints):
        pipeline = load_pipeline(checkpoint, config.pipeline, config.device)
        assert isinstance(pipeline, LearnedPipeline)
        seeds = [index * 1000 + seed for seed in config.seeds]
        title = Path(checkpoint).parts[-3:][0]
        capture, scoring = _measured(pipeline, store)
        measure = _beside(realism, OURS, scoring)
        rows += _rows(capture, store, seeds, config, progress, title, measure)
    scores: Scores = {OURS: _summaries(rows, realism, OURS)}
    if config.baselines and not isinstance(pipeline, Echo):
        for name, method in (("mean pose", MeanPose), ("nearest window", NearestWindow)):
            baseline = method.fit([RecordingStore.open(source) for source in sources])
            rows = list(_rows(baseline, store, [0], config, progress, name, _beside(realism, name)))
            scores[name] = _summaries(rows, realism, name)
    return store, scores


def _measured(pipeline: LearnedPipeline, store: RecordingStore) -> tuple[Pipeline, Measure]:
    """A pipeline bound to the files of a data set that it needs, and the metrics of its paper."""
    if isinstance(pipeline, Echo):
        with_objects = EchoOnDataset(pipeline, store.root)
        return with_objects, with_objects.score
    return pipeline, score_in_world if isinstance(pipeline, MocapEvery) else score


def _beside(realism: Realism | None, method: str, measure: Measure = score) -> Measure:
    return measure if realism is None else realism.beside(measure, method)


def _summaries(rows: list[Row], realism: Realism | None, method: str) -> dict[str, Summary]:
    """A method's scores, with FID and Diversity of its motions if configured."""
    if realism is None:
        return aggregate(rows)
    if notice := realism.notice(method):
        show(f"[yellow]{notice}[/yellow]")
    return aggregate(rows) | realism.scores(method)


def _rows(
    pipeline: Pipeline,
    store: RecordingStore,
    seeds: list[int],
    config: DictConfig,
    progress: Progress,
    title: str,
    measure: Measure = score,
) -> Iterable[Row]:
    names = store.names(config.split)
    return progress.track(
        evaluate(pipeline, store, names, seeds, config.batch_size, measure),
        total=len(names) * len(seeds),
        description=title,
    )


def main(arguments: list[str]) -> None:
    hydra_main("evaluate", run, arguments)
