"""HMD² with head path, points and images on held-out people and places: Tables 6.1 to 6.10 of the thesis.

Head tracking and what is known of the body have the errors of real devices (`--sensors`); rows that have more say so.
Latency and steps (Tables 6.5 and 6.7), by which settings are chosen, are measured on the validation split. Every row captures whole recordings with every seed; ± is the deviation over seeds. Rows without a checkpoint are left
out, which is printed. Checkpoints come by name (checkpoints/) or path.
"""

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table

from benchmarks.rivals.hmd2_paper import PAPER, PAPER_METRICS, PAPER_TAIL, paper_rows
from benchmarks.tables import result_pages as pages
from benchmarks.tables import tabling
from benchmarks.tables.hmd2_runs import BASELINES, Case, Method, Result, run_method
from benchmarks.tables.sensed import GIVEN, WRONG_HEIGHTS, add_sensors
from benchmarks.tables.wearables import WEARABLES
from wearcap.errors import WearcapError
from wearcap.evaluation.breakdown import extremes
from wearcap.metrics.table import P95, Scores, Summary, rich_lines, truth_row
from wearcap.models.checkpoint import checkpoint_file
from wearcap.recording import RecordingStore

COLUMNS = {
    "mpjpe_cm": "MPJPE",
    "best_mpjpe_cm": "best of these",
    "hand_pe_cm": "hand",
    "upper_pe_cm": "upper",
    "lower_pe_cm": "lower",
    "p95_cm": "95 %",
    "fid": "FID",
    "diversity": "divers.",
    "physicality": "phys.",
    "floor_penetration_cm": "floor",
    "skate_ratio": "sk. ratio",
    "foot_skate_cm_s": "skate",
    "jitter_m_s3": "m/s³",
    "jitter_ratio": "jitter",
    "seam_ratio": "seam",
    "world_mpjpe_cm": "world",
    **tabling.TRAINING,
}
"""Columns of the first table; "jitter" is of the truth's, "world" the MPJPE that is not anchored to the true head."""
PARTS = {
    "mpjpe_cm": "MPJPE",
    "hand_pe_cm": "hand",
    "lower_pe_cm": "lower",
    "upper_pe_cm": "upper",
    "floor_penetration_cm": "floor",
}
"""Columns of Tables 6.6 and 6.8 to 6.10."""
TAIL = {f"{P95}{name.removeprefix('mpjpe_')}": title for name, title in PARTS.items()}
FIRST = "Tables 6.1 and 6.3"
OURS = "full"
TRUTH_GIVEN = "hands of the AvatarPoser-style row that sees them (with exact sensors and bones), and the bones of rows that say so"
"""What of the truth is given to rows."""
MODALITIES = {OURS: "[points,images]", "w/o images": "[points]", "w/o points": "[images]", "head alone": "[]"}
BRIEF = "head alone, the rivals' budget"
OURS_SAW = 25.9
"""Million frames that the shared checkpoint saw in its three trainings; its own record is of the last."""
MEAN = ("pipeline=hmd2", "pipeline.refinement.feet=null")
"""Captures a rival as ours: the mean in one step, smoothed. Feet are not held: two of three learn no contacts."""
TRAINED = {
    "EgoEgo-style": ("egoego_style", ("pipeline=baseline/egoego_style",), None),
    "EgoEgo-style, its mean": ("egoego_style", MEAN, None),
    "EgoAllo-style": ("egoallo_style", ("pipeline=baseline/egoallo_style",), None),
    "EgoAllo-style, its mean": ("egoallo_style", MEAN, None),
    "AGRoL-style (head)": ("agrol_style", ("pipeline=baseline/agrol_style",), None),
    "AGRoL-style (head), its mean": ("agrol_style", MEAN, None),
    "AvatarPoser-style (head)": ("avatarposer_head", ("pipeline=pose_regressor",), None),
    "AvatarPoser-style (head and hands)": ("avatarposer_hands", ("pipeline=pose_regressor",), GIVEN),
    BRIEF: ("motion_diffusion_head", ("pipeline=hmd2", "pipeline.runtime=auto"), None),
}
"""Baselines, and our network with as little training: run, overrides that capture, and sensors (None: the table's).
Diffusions are captured twice, as their papers sample them and as the mean in one step."""
RUNS = tuple(dict.fromkeys(run for run, _, _ in TRAINED.values()))
BUDGET, BATCH = 300_000, 8
"""Frames that each of these sees, unless `rivals.py` is given another budget, and windows of a batch."""
WINDOW = {
    "egoego_style": 120,
    "egoallo_style": 128,
    "agrol_style": 196,
    "avatarposer_head": 82,
    "avatarposer_hands": 82,
}
"""Frames of a window that a network sees, where they are not 240: AvatarPoser's two pairs of poses see 41 each."""
ALONE, BY_HPS = "head alone", "refine=hps"
REFINED = "refined by HPS"
"""Name of the tables (`--keep`) in which that row stands beside the one without."""
PEOPLE = (*BASELINES, *TRAINED, ALONE)
"""Rows of the tables of people without surroundings, beside those of other sensors."""
STRIDES = (230, 180, 120, 60, 30, 10, 1)
STEPS = (1, 2, 3, 5, 10, 20, 40, 80)
LOOKAHEAD = 20
"""Frames that our windows of the sweep look ahead; longer strides have no more than a window's room for it."""
SWEEP_STRIDE_S = 0.25
"""Distance of the windows of FID in the sweeps, whose recordings are fewer."""
WIDTH = 260


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--dataset",
        type=Path,
        default=Path("datasets/simulated_camera"),
        help="whose split is captured (datasets/cmu_surrounded: real motion, too short for FID)",
    )
    parser.add_argument(
        "--training",
        nargs="+",
        default=["datasets/simulated_camera", "datasets/cmu_surrounded"],
        help="data sets that mean pose and nearest window learn from",
    )
    parser.add_argument("--split", default="test", help="train, val or test")
    add_sensors(parser)
    parser.add_argument("--seeds", type=int, default=8, help="repetitions (2 when quick)")
    parser.add_argument("--recordings", type=int, help="no more than so many of the split")
    parser.add_argument("--checkpoint", default="hmd2", help="the full model")
    parser.add_argument(
        "--runs", type=Path, default=Path("outputs/train"), help="folder of the baselines' trainings, by name"
    )
    parser.add_argument(
        "--separate",
        nargs="*",
        default=[],
        metavar="NAME=CHECKPOINT",
        help="rows trained by themselves, such as head=…",
    )
    parser.add_argument("--realism", default="motion_autoencoder", help="the motion autoencoder")
    parser.add_argument("--sweep-split", default="val", help="split of the sweeps over h and steps")
    parser.add_argument("--sweep-recordings", type=int, default=6, help="recordings of the sweeps over h and steps")
    parser.add_argument("--sweep-seeds", type=int, default=2, help="repetitions of the sweeps")
    parser.add_argument(
        "--strides",
        type=int,
        nargs="*",
        default=STRIDES,
        help="h of Table 6.5 (h = 1 takes ten times as long as all others together)",
    )
    parser.add_argument("--steps", type=int, nargs="*", default=STEPS, help="steps of Table 6.7")
    parser.add_argument("--device", default="cpu", help="device that captures")
    parser.add_argument("--jobs", type=int, default=2, help="rows at a time")
    tabling.add_people(parser)


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the tables; returns the file. With `--strangers` those of people without surroundings alone."""
    if options.strangers:
        return _strangers(options, about)
    case = _case(options)
    console = Console(width=WIDTH)
    rows = [method for method in _methods(options, console) if method.name not in options.leave]
    jobs = [(FIRST, case, rows), *([] if options.quick else _sweeps(options, case))]
    results = Parallel(n_jobs=options.jobs)(
        delayed(run_method)(method, where) for _, where, methods in jobs for method in methods
    )
    found: dict[str, list[Result]] = {}
    for title, where, methods in jobs:
        found[title] = [result for result in results[: len(methods)] if result is not None]
        results = results[len(methods) :]
        split = options.split if where is case else options.sweep_split
        if found[title]:
            console.print(_table(f"{title} ({case.dataset.name}, {split}, {case.sensors} sensors)", found[title]))
    heads = {name: COLUMNS[name] for name in PAPER_METRICS}
    paper = rich_lines("the paper", paper_rows(heads, PAPER), heads)
    console.print(f"The truth's are, beside the sensors', {TRUTH_GIVEN}.", paper)
    tail = {row.method: {name: row.scores[name] for name in TAIL} for row in found[FIRST]}
    title = "Table 6.6: 95th percentiles of each recording (cm)"
    console.print(rich_lines(title, tail | paper_rows(TAIL, PAPER_TAIL), TAIL))
    scenarios = _scenarios(found[FIRST])
    for title, rows in scenarios.items():
        console.print(rich_lines(f"{title} (cm)", rows, PARTS))
    for metric, title in PARTS.items():
        console.print(_activities(f"{title} (cm) by what was mostly done", found[FIRST], metric))
    usual = "" if options.sensors == "typical" else f"_{options.sensors}"
    path = options.output / f"hmd2_{case.dataset.name}{usual}.json"
    facts = {
        **about,
        "dataset": str(case.dataset),
        "split": options.split,
        "sensors": options.sensors,
        "truth given": TRUTH_GIVEN,
        "seeds": len(case.seeds),
        "recordings": len(case.names),
    }
    tree = {
        "about": facts,
        "tables": {title: [_short(asdict(result)) for result in rows] for title, rows in found.items()},
        "percentiles": tabling.plain(tail),
        "scenarios": {title: tabling.plain(rows) for title, rows in scenarios.items()},
    }
    return tabling.write_tree(path, tree)


def _strangers(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """People whose head alone is tracked, of data sets without points and pictures, in hmd2_people.json."""
    console, tables, path = Console(width=WIDTH), {}, options.output / "hmd2_people.json"
    there = {method.name: method for method in _methods(options, console) if method.name in PEOPLE}
    alone = there.pop(ALONE)
    ours = [
        alone,
        *(replace(alone, name=f"{ALONE}, {n} sensors", sensors=n) for n in WEARABLES if n != options.sensors),
    ]
    ours.append(replace(alone, name=f"{ALONE}, as predicted", pipeline=(*alone.pipeline, "pipeline.refinement=null")))
    ours.append(replace(alone, name=f"{ALONE}, {BY_HPS}", pipeline=(*alone.pipeline, BY_HPS)))
    ours += [replace(alone, name=f"{ALONE}, {what}", height_off_m=off) for what, off in WRONG_HEIGHTS.items()]
    ours.append(replace(alone, name=f"{ALONE}, exact sensors, bones given", sensors=GIVEN))
    ours = [method for method in ours if options.rows is None or method.name in options.rows]
    methods = ours if options.keep else [*there.values(), *ours]
    methods = [method for method in methods if method.name not in options.leave]
    for root in options.strangers:
        store, names = tabling.split_of(options, root)
        seeds = tuple(range(2 if options.quick else options.seeds))
        case = Case(store.root, tuple(names), seeds, tuple(options.training), None, options.sensors, options.device)
        results = Parallel(n_jobs=options.jobs)(delayed(run_method)(method, case) for method in methods)
        title = tabling.titled(f"People ({root.name}): {options.split}, head alone, {options.sensors} sensors", options)
        found = [result for result in results if result is not None]
        console.print(_table(title, found))
        scores = {result.method: result.scores for result in found}
        tables[title] = tabling.plain(scores | {"truth": truth_row(scores[ours[0].name])})
        facts = {**about, "split": options.split, "sensors": options.sensors, "seeds": len(seeds)}
        tabling.write_tree(path, {"about": facts, "tables": tables})
    return path


def _short(result: pages.Tree) -> pages.Tree:
    """A result as JSON: by activity, what is shown alone."""
    activities = {
        name: {metric: scores[metric] for metric in PARTS if metric in scores}
        for name, scores in result["activities"].items()
    }
    return result | {"activities": activities}


def _sweeps(options: argparse.Namespace, case: Case) -> list[tuple[str, Case, list[Method]]]:
    """Tables 6.5 and 6.7."""
    names = RecordingStore.open(case.dataset).names(options.sweep_split)[: options.sweep_recordings]
    short = replace(case, names=tuple(names), seeds=tuple(range(options.sweep_seeds)), stride_s=SWEEP_STRIDE_S)
    steps = [_ours(options, f"{n} steps", f"pipeline.sampling.steps={n}") for n in options.steps]
    return [
        ("Table 6.5: latency", short, [method for h in options.strides for method in _latencies(options, h)]),
        ("Table 6.7: steps", short, steps),
    ]


def _scenarios(results: list[Result]) -> dict[str, Scores]:
    """Tables 6.8 to 6.10: the activities in which ours is best, in the middle, and worst, by title."""
    ours = next((result.activities for result in results if result.method == OURS), {})
    ranks = extremes({name: scores["mpjpe_cm"].mean for name, scores in ours.items()})
    return {
        f"Table {number}: {place} of {len(ours)} activities, {ranks[place]}": {
            row.method: {metric: row.activities[ranks[place]][metric] for metric in PARTS} for row in results
        }
        for number, place in (("6.8", "best"), ("6.9", "median"), ("6.10", "worst"))
        if place in ranks
    }


def _case(options: argparse.Namespace) -> Case:
    if not (options.dataset / "manifest.json").is_file():
        raise WearcapError(
            "no such data set",
            where=options.dataset,
            fix="Run: wearcap prepare simulated camera=true output=datasets/simulated_camera",
        )
    names = RecordingStore.open(options.dataset).names(options.split)
    names = names[: 3 if options.quick else options.recordings]
    seeds = tuple(range(2 if options.quick else options.seeds))
    realism = options.realism if _exists(options.realism) else None
    training = tuple(options.training)
    return Case(options.dataset, tuple(names), seeds, training, realism, options.sensors, options.device)


def _exists(checkpoint: str) -> bool:
    try:
        return tabling.is_trained(checkpoint_file(checkpoint))
    except WearcapError:
        return False


def _ours(options: argparse.Namespace, name: str, *overrides: str, pipeline: str = "hmd2") -> Method:
    return Method(name, options.checkpoint, (f"pipeline={pipeline}", "pipeline.runtime=auto", *overrides))


def _latencies(options: argparse.Namespace, h: int) -> list[Method]:
    """A stride of Table 6.5 as in the paper, and as ours, in as many steps."""
    ahead = min(LOOKAHEAD, 240 - h)
    both = (f"pipeline.overlap.stride={h}", "pipeline.sampling.steps=5", "pipeline.live=true")
    return [
        _ours(options, f"h = {h}, the paper's", *both, pipeline="paper/hmd2"),
        _ours(options, f"h = {h}", *both, "pipeline.overlap.fade=10", "pipeline.overlap.lookahead=0"),
        _ours(
            options, f"h = {h}, {ahead} ahead", *both, "pipeline.overlap.fade=10", f"pipeline.overlap.lookahead={ahead}"
        ),
    ]


def training(run: str, frames: int = BUDGET, batch: int | None = None) -> list[str]:
    """Overrides that train one of `RUNS` within a budget, all on the motion of the same data, in batches of BATCH windows."""
    batch = batch or BATCH
    experiment = run if run == "motion_diffusion_head" else f"baseline/{run}"
    data = [f"experiment={experiment}", "data=hmd2_head", f"data.loading.batch_size={batch}", "callbacks=averaged"]
    return [*data, *tabling.budget(frames, batch * WINDOW.get(run, 240))]


def _methods(options: argparse.Namespace, console: Console) -> list[Method]:
    """Rows of the first table; those whose checkpoint is not there are named and left out."""
    trained = []
    for name, (run, pipeline, sensors) in TRAINED.items():
        first, *others = tabling.trainings_of(options.runs, run) or [options.runs / run / "checkpoints" / "best.ckpt"]
        trained.append(Method(name, str(first), pipeline, sensors, others=tuple(map(str, others))))
    full = _ours(options, OURS)
    sensing = [replace(full, name=f"full, {n} sensors", sensors=n) for n in WEARABLES if n != options.sensors]
    sensing.append(replace(full, name="full, the data's own sensors, bones given", sensors=GIVEN))
    ablations = [_ours(options, name, f"pipeline.use={use}") for name, use in MODALITIES.items()]
    separate = [
        Method(f"{name}, trained by itself", checkpoint)
        for name, _, checkpoint in (row.partition("=") for row in options.separate)
    ]
    wanted = [
        *(Method(name) for name in BASELINES),
        *trained,
        *ablations,
        *sensing,
        *separate,
        _ours(options, "full, the paper's windows", pipeline="paper/hmd2"),
        _ours(options, "full, sampled in five steps", pipeline="ablation/hmd2_sampled"),
        _ours(options, f"full, {BY_HPS}", BY_HPS),
    ]
    there = [method for method in wanted if method.checkpoint is None or _exists(method.checkpoint)]
    for method in wanted:
        if method not in there:
            run = TRAINED.get(method.name, ("",))[0]
            line = f"left out: {method.name} (no checkpoint {method.checkpoint!r})"
            line = tabling.left_out(method.name, "hmd2", run, method.checkpoint) if run else line
            console.print(line, markup=False, soft_wrap=True)
    return there


def _table(title: str, results: list[Result]) -> Table:
    rows = {result.method: result.scores for result in results}
    columns = {name: head for name, head in COLUMNS.items() if any(name in scores for scores in rows.values())}
    return rich_lines(title, rows | {"truth": truth_row(results[0].scores)}, columns)


def _activities(title: str, results: list[Result], metric: str) -> Table:
    """Means of one metric by activity."""
    rows = {
        result.method: {
            activity: Summary(scores[metric].mean, None, 1) for activity, scores in result.activities.items()
        }
        for result in results
    }
    return rich_lines(
        title, rows, {name: name[:14] for name in sorted({each for row in rows.values() for each in row})}
    )


HEADLINE = {
    "nearest window": "nearest window of the training, looked up",
    "EgoEgo-style, its mean": "EgoEgo-style, head: its mean",
    "EgoAllo-style, its mean": "EgoAllo-style, head: its mean",
    "AGRoL-style (head), its mean": "AGRoL-style, head: its mean",
    "AvatarPoser-style (head)": "AvatarPoser-style, head",
    "AvatarPoser-style (head and hands)": "AvatarPoser-style, which also sees both hands",
    BRIEF: "ours, head alone, trained as briefly",
    "full": "**all of it**",
    "full, poor sensors": "**all of it**, poor sensors",
    "head alone": "the same checkpoint, head alone",
}
"""Rows of the page's first table, and what the page calls them."""
CLOCKS = {
    "hmd2_online_small_fps": "Online, from head poses, points and embeddings, which are given, to poses, 10 new frames a window, "
    "beside real time",
    "hmd2_online_full_fps": "The same with the full model, of drawn weights",
    "hmd2_runner_vs_eager": "The same: the runner, beside an eager loop of equal steps and precision",
    "voxelize_frames_per_second": "Grids of a whole recording's points around the body, SLAM given, beside real time",
    "voxelize_vs_brute_force": "The same, beside looking at all points for each frame",
}
"""Benchmarks: what is measured, what is given, and what it is held against."""


def page(trees: pages.Trees, speed: dict[str, list[pages.Tree]]) -> pages.Page:
    """What docs/results/hmd2.md says."""
    found, people = pages.commands(trees), trees.get("hmd2_people", {"tables": {}})
    trees = {name: tree for name, tree in trees.items() if name != "hmd2_people"}
    simulated, real = (
        {row["method"]: row["scores"] for row in _rows(trees, name)} for name in ("simulated_camera", "cmu_surrounded")
    )
    strangers = next((rows for title, rows in people["tables"].items() if title.startswith("People (hdm05)")), {})
    shown = (("CMU", real), ("HDM05", strangers), ("simulated", simulated))
    online = pages.figures_of(speed, "hmd2_online_small_fps")
    return pages.Page(
        title="[HMD²](../hmd2.md): figures",
        headline=pages.Grid(
            "Whole recordings, anchored to the true head; means over repetitions, ± their deviation (cm); jitter as a multiple of "
            "the truth's. CMU has points and pictures of simulated surroundings; HDM05's person, of another laboratory, has none, "
            "and only the head is seen. “Its mean”: one step of the rival's diffusion, as ours.",
            ("", *(f"{what}: {METRICS[metric]}" for what, metric in COMPARED)),
            [
                [label, *(pages.text(dict(shown)[what].get(name, {}).get(metric)) for what, metric in COMPARED)]
                for name, label in HEADLINE.items()
                if any(name in rows for _, rows in shown)
            ],
        ),
        held_out="People and places of the test split of simulated wearers, four CMU subjects "
        f"({trees['hmd2_cmu_surrounded']['about']['recordings']} short recordings) and one person of HDM05. Everything was chosen on the "
        "validation split.",
        simulated="People, flats, points and pictures of the simulated wearers; on CMU the motion is real, and surroundings, points "
        "and pictures are simulated. The head's path has the jitter of [simulation](simulation.md). Rows without other words have "
        "typical sensors.",
        limits=(*_limits(simulated, real, strangers), _codes(), *_refined(people)),
        full=[*pages.score_grids(people, _labels(), "repetitions"), *_grids(trees)],
        commands=found,
        speed=f"{pages.times(online)} online, head's path and points given ({pages.machines(online)})"
        if online
        else "",
        clocks=CLOCKS,
        pictures=(
            *pages.ranked("hmd2"),
            ("hmd2_samples.png", "One input, several motions (four samples, above them the truth)"),
        ),
    )


SENSING = ("full, ideal sensors", OURS, "full, poor sensors")
"""Rows over which README gives the range."""
METRICS = {
    "mpjpe_cm": "MPJPE",
    "hand_pe_cm": "hands",
    "lower_pe_cm": "lower body",
    "fid": "FID",
    "jitter_ratio": "jitter",
}
COMPARED = (
    *(("CMU", metric) for metric in ("mpjpe_cm", "hand_pe_cm", "lower_pe_cm", "jitter_ratio")),
    ("HDM05", "mpjpe_cm"),
    *(("simulated", metric) for metric in ("mpjpe_cm", "fid")),
)
"""Columns of the page's table."""


def _limits(
    simulated: dict[str, pages.Tree], real: dict[str, pages.Tree], strangers: dict[str, pages.Tree]
) -> tuple[str, ...]:
    """The weak sides, with their figures."""

    def error(rows: dict[str, pages.Tree], name: str, metric: str = "mpjpe_cm", digits: int = 1) -> str:
        return pages.mean(rows.get(name, {}).get(metric), digits)

    fid, paper = PAPER_METRICS.index("fid"), PAPER["HMD² (h = 180)"]
    ours, rival, hands = BRIEF, "EgoEgo-style, its mean", "AvatarPoser-style (head and hands)"
    return (
        "A real walk with Aria glasses has knees more bent than people's "
        "([the card](../../checkpoints/hmd2.md) has the angles).",
        f"On HDM05's person HMD² has no lead over the EgoEgo-style rival of equal budget ({error(strangers, ours)} against "
        f"{error(strangers, rival)} cm; the shared checkpoint, which learned longer, {error(strangers, ALONE)}). On CMU it has: "
        f"{error(real, ours)} against {error(real, rival)} cm.",
        f"Pictures hurt on simulated wearers: {error(simulated, 'w/o images', digits=2)} cm without them, "
        f"{error(simulated, OURS, digits=2)} with them.",
        f"Points and pictures together bring little: {error(real, OURS, digits=2)} against {error(real, ALONE, digits=2)} cm for the head "
        f"alone on CMU, {error(simulated, OURS, digits=2)} against {error(simulated, ALONE, digits=2)} on simulated wearers, where the "
        f"head alone has the better legs ({error(simulated, ALONE, 'lower_pe_cm')} against {error(simulated, OURS, 'lower_pe_cm')} cm) and "
        f"FID ({error(simulated, ALONE, 'fid')} against {error(simulated, OURS, 'fid')}).",
        f"A regressor that also sees both hands is {error(real, hands)} cm off on CMU, ours {error(real, OURS)}; in the lower body "
        f"{error(real, hands, 'lower_pe_cm')} against {error(real, OURS, 'lower_pe_cm')}.",
        f"Jitter on simulated wearers is {error(simulated, OURS, 'jitter_ratio')} times the truth's. Bad are arms out of the camera's "
        "sight, and CMU's dances and jumps.",
        f"Rivals that see the head alone, and the row of ours trained as briefly (the mean of three trainings), learned from the people that our checkpoint learned "
        f"from last, {_frames(real)} million frames each, at the best of three learning rates; our checkpoint {OURS_SAW} in three "
        "trainings. They are compared on real motion alone. Captured as their papers sample them, most are worse: `--all`.",
        f"The paper reports {paper[0]:.2f} cm and an FID of {paper[fid]:.2f} on its own real recordings (Nymeria): no comparison. FID needs more windows than "
        "CMU's held-out subjects have. FIDs here are in the space of the motion autoencoder before 2026-11-28.",
        "No recording of a real head-mounted device has been scored.",
    )


def _codes() -> str:
    """The linear code of the points beside the paper's convolutions, trained alike."""
    rows = json.loads((pages.RESULTS / "voxels.json").read_text(encoding="utf-8"))["rows"]
    linear, convolutions = rows["linear"], rows["convolutions"]
    off = [f"{row['held_distance_cm']:.2f} cm off (IoU {row['occupancy_iou']:.2f})" for row in (convolutions, linear)]
    sizes = [f"{row['parameters'] / 1000:.0f} thousand parameters" for row in (convolutions, linear)]
    faster = linear["encoded_per_s"] / convolutions["encoded_per_s"]
    return (
        f"Points as 128 numbers: the paper's convolutions rebuild cells that hold a point {off[0]}, with {sizes[0]}, our linear code, "
        f"trained in as many steps, {off[1]}, with {sizes[1]}, and encodes {faster:.0f} times as many grids a second. What either does to "
        "the motion was not measured."
    )


def _refined(people: pages.Tree) -> tuple[str, ...]:
    """What refining by HPS's energy brings, of the tables that were made for it."""
    parts = []
    for data, whom in (("hdm05", "HDM05's person"), ("cmu", "CMU")):
        start = f"{REFINED}, People ({data})"
        rows = next((rows for title, rows in people["tables"].items() if title.startswith(start)), None)
        if rows is None:
            return ()
        before, after = rows[ALONE], rows[f"{ALONE}, {BY_HPS}"]
        slid, joints = (
            f"{pages.mean(before[metric], digits)} → {pages.mean(after[metric], digits)}"
            for metric, digits in (("foot_skate_cm_s", 1), ("mpjpe_cm", 2))
        )
        parts.append(f"on {whom} {slid} cm/s (joints {joints} cm)")
    return (
        f"`{BY_HPS}` (HPS's energy over the capture, head alone, repaired hips) lets standing feet slide less, {' and '.join(parts)}; it takes "
        "longer than the capture itself, a stream cannot have it, and it is off unless wished.",
    )


def _frames(rows: dict[str, pages.Tree]) -> str:
    """Million frames that rivals which see the head alone, and ours beside them, saw."""
    seen = [rows[row]["frames_seen_m"] for row, (_, _, sensors) in TRAINED.items() if sensors is None and row in rows]
    return pages.ranged(seen)


def _grids(trees: pages.Trees) -> list[pages.Grid]:
    """All tables."""
    grids = [
        pages.grid_of(
            _table(
                f"{title} ({name.removeprefix('hmd2_')}{', validation' * (title != FIRST)})", [*map(Result.of, rows)]
            ),
            tree.get("origins", {}).get(title, tree["about"]),
            _repetitions(rows),
        )
        for name, tree in trees.items()
        for title, rows in tree["tables"].items()
        if rows
    ]
    for tree in trees.values():
        parts = {"Table 6.6: 95th percentiles": tree.get("percentiles"), **tree.get("scenarios", {})}
        found = {title: rows for title, rows in parts.items() if rows}
        grids += pages.score_grids({"about": tree["about"], "tables": found}, _labels())
    first = {name: [Result.of(row) for row in tree["tables"].get(FIRST, [])] for name, tree in trees.items()}
    for name, rows in first.items():
        if max((len(row.activities) for row in rows), default=0) > 4:  # of fewer, Tables 6.8 to 6.10 show enough
            table = _activities(
                f"Tables 6.8–6.10: MPJPE (cm) by what was mostly done ({name.removeprefix('hmd2_')})", rows, "mpjpe_cm"
            )
            grids.append(pages.grid_of(table, trees[name]["about"]))
    return grids


def _labels() -> dict[str, tuple[str, int]]:
    """Columns of the page's tables with their digits."""
    return {name: (title, 2) for name, title in COLUMNS.items()}


def _rows(trees: pages.Trees, name: str) -> list[pages.Tree]:
    return trees.get(f"hmd2_{name}", {}).get("tables", {}).get(FIRST, [])


def _repetitions(rows: list[pages.Tree]) -> str:
    count = max((score["seeds"] for row in rows for score in row["scores"].values()), default=1)
    return f"{count} repetitions" if count > 1 else ""
