"""`wearcap evaluate`: whole recordings of a split, over seeds, beside the trivial baselines."""

from collections.abc import Iterable
from pathlib import Path

from omegaconf import DictConfig, ListConfig
from rich import print as show
from rich.progress import Progress

from wearcap.cli.conf import hydra_main
from wearcap.cli.load import load_pipeline, trained_on
from wearcap.metrics.table import Row, Scores, aggregate, rich_table, write_scores
from wearcap.pipelines.baselines import MeanPose, NearestWindow
from wearcap.pipelines.evaluation import Pipeline, evaluate
from wearcap.recording import RecordingStore

HELP = "score a checkpoint: wearcap evaluate checkpoint=… [dataset=DIR] [split=test]"


def run(config: DictConfig) -> Scores:
    """Evaluate the checkpoint(s) and baselines; prints and saves the table."""
    checkpoints = (
        list(config.checkpoint) if isinstance(config.checkpoint, ListConfig) else [config.checkpoint]
    )
    sources, validated = trained_on(checkpoints[0])
    store = RecordingStore.open(config.dataset or validated)
    with Progress(transient=True) as progress:
        rows: list[Row] = []
        for index, checkpoint in enumerate(checkpoints):
            pipeline = load_pipeline(checkpoint, config.pipeline, config.device)
            seeds = [index * 1000 + seed for seed in config.seeds]
            rows += _rows(pipeline, store, seeds, config, progress, Path(checkpoint).parts[-3:][0])
        scores: Scores = {"wearcap": aggregate(rows)}
        if config.baselines:
            for name, method in (("mean pose", MeanPose), ("nearest window", NearestWindow)):
                baseline = method.fit([RecordingStore.open(source) for source in sources])
                scores[name] = aggregate(list(_rows(baseline, store, [0], config, progress, name)))
    about = {
        "dataset": str(store.root),
        "split": config.split,
        "checkpoint": ", ".join(map(str, checkpoints)),
    }
    show(rich_table(f"{store.root.name}, {config.split} split", scores))
    write_scores(config.output, scores, about)
    show(f"table: {config.output}")
    return scores


def _rows(
    pipeline: Pipeline,
    store: RecordingStore,
    seeds: list[int],
    config: DictConfig,
    progress: Progress,
    title: str,
) -> Iterable[Row]:
    names = store.names(config.split)
    return progress.track(
        evaluate(pipeline, store, names, seeds, config.lanes),
        total=len(names) * len(seeds),
        description=title,
    )


def main(arguments: list[str]) -> None:
    hydra_main("evaluate", run, arguments)
