"""ECHO on held-out people, places and objects: the paper's Tables 1, 2, 3, 4 (ablation) and S2 on the data at hand.

Bodies and objects are measured where they are put in the world, over whole recordings. Checkpoints come by name
(checkpoints/) or path; those of baselines and ablations from RUNS/NAME/checkpoints/best.ckpt. A row without its
checkpoint is left out, and the command that trains it is printed (`TRAININGS`). Means and spreads are over seeds of the
diffusion, as in the paper; where there are trainings with other seeds (RUNS/NAME_1, …_2), over these.
"""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from hydra.utils import instantiate
from rich.console import Console
from rich.progress import Progress

from benchmarks.rivals.echo_baselines import NearestEcho, RigidWrist
from benchmarks.rivals.echo_paper import PAPER, PAPER_HUMAN
from benchmarks.tables import echo_limits, tabling
from benchmarks.tables import result_pages as pages
from benchmarks.tables.echo_limits import EQUAL
from benchmarks.tables.echo_rows import Captured, Method, captured, pipeline_of, scenario_of
from benchmarks.tables.sensed import GIVEN, WRONG_HEIGHTS
from benchmarks.tables.tabling import plain
from wearcap.cli.conf import compose
from wearcap.metrics.table import TRUTH, Scores, Summary, aggregate, markdown_table, truth_row
from wearcap.recording import RecordingStore
from wearcap.runtime.system import CaptureInput
from wearcap.systems.echo.scores import score_echo

OF_BODIES = {
    "mpjpe_mm": ("MPJPE (mm)", 1),
    "upper_pe_mm": ("upper body (mm)", 1),
    "lower_pe_mm": ("lower body (mm)", 1),
    "hand_pe_mm": ("hands (mm)", 1),
    "mpjve_mm": ("MPJVE (mm a frame)", 1),
    "mpjve_printed": ("MPJVE as the paper prints it", 1),
    "foot_contact": ("FC", 2),
    "jitter_m_s3": ("jitter (m/s³)", 1),
    "jitter_ratio": ("jitter, of the truth's", 2),
    "foot_skate_cm_s": ("skate (cm/s)", 1),
    "skate_ratio": ("skate, of the truth's", 2),
    "floor_penetration_cm": ("into the floor (cm)", 2),
    "physicality": ("physicality", 4),
}
"""Columns of the tables with their digits. Ours of MPJVE is in the unit of ECHO's words, which its figures cannot have
(`joint_step_error_mm`): they have a column of their own."""
LABELS = {
    **OF_BODIES,
    "v2v_cm": ("E_v2v (cm)", 1),
    "symmetric_v2v_cm": ("E_v2v modulo symmetry (cm)", 1),
    "center_cm": ("E_c (cm)", 1),
    "loose_center_cm": ("E_c of loose objects (cm)", 1),
    "fastened_center_cm": ("E_c of doors, drawers, windows (cm)", 1),
    "add_s_cm": ("ADD-S (cm)", 1),
    "rotation_deg": ("rotation (°)", 1),
    "symmetric_rotation_deg": ("rotation modulo symmetry (°)", 1),
    "quaternion": ("quaternion", 2),
    "touch_f1": ("contact F1", 2),
    "training_minutes": ("minutes learned from", 0),
}
"""Columns of the tables of objects."""
BODY, OBJECTS = ({name: heading for name, (heading, _) in of.items()} | tabling.TRAINING for of in (OF_BODIES, LABELS))
"""Their headings, of people alone and with objects."""
ANYWHERE = ("pipeline=echo", "pipeline.freedoms=false")
"""Like the rivals, which know no hinges, rails or floor that an object keeps to."""
CONVEYOR = ("pipeline=ablation/echo_conveyor",)
"""A sample of the plausible motions, as ECHO's, in place of their mean."""
UNGUIDED = (*ANYWHERE, "pipeline.contacts.guidance=null")
MEAN = (*UNGUIDED, "pipeline.refinement.feet=null")
"""Captures a rival as ours: the mean of averaged windows, arms that reach the wrists, smoothed. It learns no contacts."""
HEAD_ALONE = ("pipeline.sampling.wrists=null", "pipeline.refinement.wrists=false")
EVEN = (*CONVEYOR, "pipeline.sampling.spacing=1.0")
SAMPLED = (*CONVEYOR, "pipeline.freedoms=false")
"""Samples on the conveyor, like the rivals'; ablations of the network, which is trained for it, are scored so."""
SAMPLED_UNGUIDED = (*SAMPLED, "pipeline.contacts.guidance=null")
SHORT = ("experiment=echo",)
BUDGET = 384_000
"""Frames that each of these sees, ours among them, unless `rivals.py` is given another budget."""
BATCH, LONG = (16, 60), (10, 98)
"""Windows of a batch and their frames, and those of AGRoL."""
TRAININGS: dict[str, tuple[str, ...]] = {
    "echo_short": SHORT,
    "echo_window": (*SHORT, "features.frame=window"),
    "echo_world": (*SHORT, "features.frame=world"),
    "echo_without_contacts": (*SHORT, "model.contacts=false"),
    "echo_without_people": (*SHORT, "data.sources.cmu=null"),
    "echo_without_auxiliary": (
        *SHORT,
        "model.loss_weights={object_vertices: 0.0, joints: 0.0, velocity: 0.0, skate: 0.0, held: 0.0, foot_contact: 0.0}",
    ),
    "echo_paper_losses": (
        *SHORT,
        "model.loss_weights={object_vertices: 0.1, joints: 0.1, velocity: 0.0, skate: 0.05, held: 0.0, foot_contact: 0.0}",
    ),
    "echo_true_orientations": (*SHORT, "data.dataset.content.canonical=false"),
    "echo_without_lead": (*SHORT, "model.levels.lead=[]", "model.levels.chances=[]"),
    "echo_three_streams": (*SHORT, "model.net.streams=3"),
    "bodiffusion_object": ("experiment=baseline/bodiffusion_object",),
    "bodiffusion_object_window": ("experiment=baseline/bodiffusion_object", "features.frame=window"),
    "bodiffusion": ("experiment=baseline/bodiffusion",),
    "egoallo_human": ("experiment=baseline/egoallo_human",),
    "agrol_human": ("experiment=baseline/agrol_human",),
}
RUNS = tuple(TRAININGS)
"""Overrides of `wearcap train` by the run's name: ECHO trained briefly, and each ablation of it trained as long: the
paper's canonical frame (window) and none (world), the losses of the three modalities alone, the weights of ECHO eq. 13,
and a token per frame and modality; and the baselines, as long, in the same frames as ours."""
ABLATIONS: dict[str, tuple[str, ...]] = {
    "ours without guidance, as long as the others": ("echo_short", *SAMPLED_UNGUIDED),
    "the same, objects move untouched": ("echo_short", *SAMPLED_UNGUIDED, "pipeline.contacts.static_threshold=null"),
    "the same, guided by contacts": ("echo_short", *SAMPLED),
    "the paper's frame": ("echo_window", *SAMPLED_UNGUIDED),
    "no canonical frame": ("echo_world", *SAMPLED_UNGUIDED),
    "no contacts": ("echo_without_contacts", *SAMPLED_UNGUIDED),
    "no humans alone": ("echo_without_people", *SAMPLED_UNGUIDED),
    "no auxiliary losses": ("echo_without_auxiliary", *SAMPLED_UNGUIDED),
    "the paper's weights of losses": ("echo_paper_losses", *SAMPLED_UNGUIDED),
    "objects asked for as they are, not modulo symmetry": ("echo_true_orientations", *SAMPLED_UNGUIDED),
    "contacts learned as often as the rest, none in the lead": ("echo_without_lead", *SAMPLED_UNGUIDED),
    "three tokens per frame": ("echo_three_streams", *SAMPLED_UNGUIDED),
}
RIVALS: dict[str, tuple[str, ...]] = {
    "ours, the same budget": ("echo_short", *ANYWHERE),
    "ours, the same budget, sampled": ("echo_short", *SAMPLED),
    "ours, the same budget, sampled without guidance": ("echo_short", *SAMPLED_UNGUIDED),
    "BoDiffusion-style + object": ("bodiffusion_object", "pipeline=baseline/bodiffusion_object"),
    "BoDiffusion-style + object, its mean": ("bodiffusion_object", *MEAN),
    "BoDiffusion-style + object, the paper's frame": (
        "bodiffusion_object_window",
        "pipeline=baseline/bodiffusion_object",
    ),
    "BoDiffusion-style": ("bodiffusion", "pipeline=baseline/bodiffusion"),
    "BoDiffusion-style, its mean": ("bodiffusion", *MEAN, "pipeline.active_objects=none"),
}
HUMANS: dict[str, tuple[str, ...]] = {
    **{name: row for name, row in RIVALS.items() if "paper's frame" not in name and "guidance" not in name},
    "EgoAllo-style (head)": ("egoallo_human", "pipeline=baseline/bodiffusion"),
    "EgoAllo-style (head), its mean": ("egoallo_human", *MEAN, "pipeline.active_objects=none", *HEAD_ALONE),
    "AGRoL-style": ("agrol_human", "pipeline=baseline/bodiffusion"),
    "AGRoL-style, its mean": ("agrol_human", *MEAN, "pipeline.active_objects=none"),
    "ours, the same budget, no humans alone": ABLATIONS["no humans alone"],
}
"""Rows of Table 2 with trainings of their own."""
SETTINGS = {
    "ours": ("pipeline=echo",),
    "hinges and rails unknown": ANYWHERE,
    "objects move untouched": ("pipeline=echo", "pipeline.contacts.static_threshold=null"),
    "initial object poses observed": ("pipeline=echo", "pipeline.placed=true"),
    "not guided by contacts": UNGUIDED,
    "guided to 5 cm from the surface": ("pipeline=echo", "pipeline.contacts.guidance.within_m=0.05"),
    "guided by the holding wrists, too": ("pipeline=echo", "pipeline.contacts.guidance.held=1.0"),
    "not anchored to the head": ("pipeline=echo", "pipeline.anchor=false"),
    "windows in two steps": ("pipeline=echo", "pipeline.sampling.rewindow_steps=2"),
    "windows in five steps": ("pipeline=echo", "pipeline.sampling.rewindow_steps=5"),
    "windows that advance by 7 frames": ("pipeline=echo", "pipeline.sampling.rewindow=7"),
    "windows without their mirrored twins": ("pipeline=echo", "pipeline.sampling.mirror_average=false"),
    "overlap inpainted, not averaged": ("pipeline=echo", "pipeline.sampling.average=false"),
    "online: 20 frames of latency": ("pipeline=echo_online", "pipeline.runtime=eager"),
    "conveyor": CONVEYOR,
    "conveyor, online: 20 frames of latency": (
        "pipeline=echo_online",
        "pipeline.runtime=eager",
        "pipeline.sampling.rewindow=null",
        "pipeline.sampling.rewindow_steps=null",
    ),
    "conveyor, steps evenly spaced": EVEN,
    "conveyor, the stochastic posterior": (*CONVEYOR, "pipeline.sampling.eta=1.0"),
    "conveyor, noise redrawn (eq. 11 as printed)": (*EVEN, "pipeline.sampling.step=redraw"),
    "all as in the paper": ("pipeline=paper/echo",),
}
TRUTH_GIVEN = "exact wrists and heads, floor, bones (but in rows of wrong height and of typical and poor tracking), and which object is active, are given to all rows"
SHARES = {"human": (0.01, 0.05, 0.1, 0.25, 1.0), "object": (0.01, 0.05, 0.1, 0.25, 1.0), "contact": (0.01, 0.05, 0.1, 0.25, 1.0)}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--datasets", type=Path, default=Path("datasets"), help="folder of the prepared data sets")
    parser.add_argument("--split", default="test", help="train, val or test")
    parser.add_argument("--checkpoint", default="echo", help="our checkpoint")
    parser.add_argument("--runs", type=Path, default=Path("outputs/train"), help="folder of the other trainings")
    parser.add_argument("--recordings", type=int, help="no more than so many of each data set")
    parser.add_argument("--seeds", type=int, default=4, help="runs of each row")
    parser.add_argument("--items", type=int, default=12, help="recordings that share a batch")
    parser.add_argument(
        "--pipeline", nargs="*", default=[], help="overrides for all rows, as pipeline.sampling.per_frame=1"
    )
    parser.add_argument(
        "--parts",
        nargs="*",
        default=["objects", "rivals", "ablation", "sparse", "human"],
        choices=list(PARTS),
        help="tables to make",
    )
    tabling.add_people(parser)


def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    """Print and write the tables; returns the file."""
    console, found = Console(width=200), {}
    path = options.output / "echo.json"
    with Progress(transient=True, console=console) as progress:
        makers = [PARTS[part] for part in options.parts] + [partial(_strangers, root) for root in options.strangers]
        for make in makers:
            title, columns, scores = make(options, progress)
            ours = next((row for row in scores.values() if f"{TRUTH}physicality" in row), {})
            scores = scores | {"truth": truth_row(ours)}
            found[title] = plain(scores)
            console.print(f"\n{title}\n\n{markdown_table(scores, columns)}", markup=False, soft_wrap=True)
            tabling.write_tree(path, {"about": about, "tables": found})
    return path


def _objects(options: argparse.Namespace, progress: Progress) -> tuple[str, Mapping[str, str], Scores]:
    """Table 1: ours beside what it must beat."""
    store, names = tabling.recordings_of(options, "simulated_objects")
    ours = Method("ours", options.checkpoint, measured=True)
    scores: Scores = {}
    data = instantiate(
        compose("train", ["experiment=echo", "paths.run=none", f"paths.datasets={options.datasets}"]).data,
        _convert_="all",
    )
    training_windows = data.dataset("train")
    minutes = sum(store.entries[name].duration_s for name in store.names("train")) / 60
    nearest = _baseline(NearestEcho.fit(training_windows), store, names, ours)
    scores["nearest training window"] = nearest | {"training_minutes": Summary(minutes, None, 1)}
    wrist = RigidWrist.fit(training_windows)
    mine, stuck = [], []
    for one in _captured(ours, options, progress, store, names):
        mine.append(score_echo(one.motion, one.truth, one.name, one.seed))
        stuck.append(score_echo(wrist.attached(one.motion, one.item), one.truth, one.name, one.seed))
    took = tabling.training_of(options.checkpoint)
    scores |= {"ours, object stuck to the nearer wrist": aggregate(stuck), "ours": aggregate(mine) | took}
    more = [
        Method("ours, environment exact", options.checkpoint),
        Method("ours, hinges and rails unknown", options.checkpoint, ANYWHERE),
        Method("ours, human alone", options.checkpoint, ("pipeline=echo", "pipeline.active_objects=none")),
    ]
    scores |= _scores(more, options, progress, store, names)
    return (
        f"Table 1: objects, {options.split}; {TRUTH_GIVEN}; hinges and rails as people measure them, but where a row says otherwise",
        OBJECTS,
        scores | PAPER,
    )


def _settings(options: argparse.Namespace, progress: Progress) -> tuple[str, Mapping[str, str], Scores]:
    """How frames are denoised; defaults are chosen by this table, on the validation split."""
    store, names = tabling.recordings_of(options, "simulated_objects")
    chosen = {name: changes for name, changes in SETTINGS.items() if name not in options.leave}
    methods = [Method(name, options.checkpoint, changes) for name, changes in chosen.items()]
    return f"Settings: {options.split}", OBJECTS, _scores(methods, options, progress, store, names)


def _ablation(options: argparse.Namespace, progress: Progress) -> tuple[str, Mapping[str, str], Scores]:
    """Table 4: networks that were trained alike, but for one choice."""
    store, names = tabling.recordings_of(options, "simulated_objects")
    methods = _trained(ABLATIONS, options, progress)
    return f"Ablation: {options.split}", OBJECTS, _scores(methods, options, progress, store, names)


def _rivals(options: argparse.Namespace, progress: Progress) -> tuple[str, Mapping[str, str], Scores]:
    """Rows of Table 1 beside ours, all trained within one budget."""
    store, names = tabling.recordings_of(options, "simulated_objects")
    methods = _trained(RIVALS, options, progress)
    return f"{EQUAL}: {options.split}", OBJECTS, _scores(methods, options, progress, store, names)


def _trained(rows: dict[str, tuple[str, ...]], options: argparse.Namespace, progress: Progress) -> list[Method]:
    """Those of which there is a training, and that do not stay as they were published."""
    methods = []
    for name, (run, *pipeline) in rows.items():
        if name in options.leave:
            continue
        if paths := tabling.trainings_of(options.runs, run):
            methods.append(Method(name, str(paths[0]), tuple(pipeline), others=tuple(map(str, paths[1:]))))
        else:
            path = options.runs / run / "checkpoints" / "best.ckpt"
            progress.console.print(tabling.left_out(name, "echo", run, path), markup=False, soft_wrap=True)
    return methods


def training(run: str, frames: int = BUDGET, batch: int | None = None) -> list[str]:
    """Overrides that train one of `RUNS` within a budget, in batches of as many frames as BATCH windows of ours have."""
    windows, length = LONG if run == "agrol_human" else BATCH
    windows = round(batch * windows / BATCH[0]) if batch else windows
    return [*TRAININGS[run], f"data.loading.batch_size={windows}", *tabling.budget(frames, windows * length)]


def _sparse(options: argparse.Namespace, progress: Progress) -> tuple[str, Mapping[str, str], Scores]:
    """Tables 3 and S2: a share of one modality's frames is given."""
    store, names = tabling.recordings_of(options, "simulated_objects")
    rows = [None, *((modality, share) for modality, shares in SHARES.items() for share in shares)]
    methods = [Method(_given(row), options.checkpoint, UNGUIDED, row) for row in rows]
    for label, changes in (("guided", ANYWHERE), ("guided, hinges and rails known", ("pipeline=echo",))):
        guided = [(None, "nothing"), (("contact", 1.0), "100 % of contact")]
        methods += [Method(f"{what}, {label}", options.checkpoint, changes, row) for row, what in guided]
    return f"Tables 3, S2: observed, {options.split}", OBJECTS, _scores(methods, options, progress, store, names)


def _given(row: tuple[str, float] | None) -> str:
    return "nothing" if row is None else f"{100 * row[1]:g} % of {row[0]}"


def _human(options: argparse.Namespace, progress: Progress) -> tuple[str, Mapping[str, str], Scores]:
    """Table 2: people without objects."""
    scores = _people(options, progress, *tabling.recordings_of(options, "cmu"))
    title = tabling.titled(f"Table 2: CMU, {options.split}; {TRUTH_GIVEN}", options)
    return title, BODY, scores | ({} if options.keep else PAPER_HUMAN)


def _strangers(root: Path, options: argparse.Namespace, progress: Progress) -> tuple[str, Mapping[str, str], Scores]:
    """The same rows on people of another laboratory."""
    scores = _people(options, progress, *tabling.split_of(options, root))
    return tabling.titled(f"People ({root.name}): {options.split}; {TRUTH_GIVEN}", options), BODY, scores


def _people(options: argparse.Namespace, progress: Progress, store: RecordingStore, names: list[str]) -> Scores:
    """Rows of bodies: ours, with the wearer's bones and with a wrong height, then trained rivals."""
    plain = {"as sampled": "pipeline.refinement=null", "windows not mirrored": "pipeline.sampling.mirror_average=false"}
    methods = [Method("ours", options.checkpoint)]
    methods += [Method(f"ours, {row}", options.checkpoint, ("pipeline=echo", how)) for row, how in plain.items()]
    methods += [Method(f"ours, {what}", options.checkpoint, height_off_m=off) for what, off in WRONG_HEIGHTS.items()]
    methods += [Method(f"ours, {name} tracking", options.checkpoint, sensors=name) for name in ("typical", "poor")]
    methods = [method for method in methods if options.rows is None or method.name in options.rows]
    methods += [] if options.keep else _trained(HUMANS, options, progress)
    return _scores(methods, options, progress, store, names)


def _scores(
    methods: list[Method], options: argparse.Namespace, progress: Progress, store: RecordingStore, names: list[str]
) -> Scores:
    scores: Scores = {}
    for method in methods:
        made = [
            score_echo(one.motion, one.truth, one.name, one.seed)
            for one in _captured(method, options, progress, store, names)
        ]
        scores[method.name] = aggregate(made) | tabling.training_of(method.checkpoint, *method.others)
        scores |= tabling.upright(method.name, made) if method.name == "ours" else {}
        shown = (f"{key} {scores[method.name][key]}" for key in OBJECTS if key in scores[method.name])
        progress.console.print(f"{method.name}: {', '.join(shown)}", soft_wrap=True)
    return scores


def _captured(
    method: Method, options: argparse.Namespace, progress: Progress, store: RecordingStore, names: list[str]
) -> Iterator[Captured]:
    """With all seeds; of several trainings, each with a seed of its own. Wrists that are tracked beside a head that is
    `UPSIDE_DOWN` would be refused as swapped."""
    if method.sensors != GIVEN:
        names = [name for name in names if name not in tabling.UPSIDE_DOWN]
    changed = replace(method, pipeline=(*method.pipeline, *options.pipeline), others=())
    runs = [(changed, list(range(2 if options.quick else options.seeds)))]
    if method.others:
        runs = [(replace(changed, checkpoint=path), [n]) for n, path in enumerate((method.checkpoint, *method.others))]
    bar = progress.add_task(method.name, total=sum(len(seeds) for _, seeds in runs) * len(names))
    for training, seeds in runs:
        for one in captured(training, store, names, seeds, options.items):
            progress.advance(bar)
            yield one


def _baseline(method: NearestEcho, store: RecordingStore, names: list[str], like: Method) -> dict[str, Summary]:
    """Scores of what draws nothing."""
    echo = pipeline_of(like)
    made = []
    for name in names:
        source = CaptureInput(store.load(name), store.root)
        motion = method.capture_scenarios([scenario_of(echo, source, like.measured)], [0])[0]
        made.append(echo.score(motion, source, 0))
    return aggregate(made)


PARTS = {
    "objects": _objects,
    "rivals": _rivals,
    "ablation": _ablation,
    "settings": _settings,
    "sparse": _sparse,
    "human": _human,
}


OBJECTS_1, EQUAL_1, CMU, HDM05 = "Table 1:", "Table 1, equal", "Table 2", "People (hdm05)"
HEADLINE = (
    (OBJECTS_1, "nearest training window", "objects: nearest window of the training, looked up"),
    (OBJECTS_1, "ours", "objects: **ours**"),
    (OBJECTS_1, "ours, hinges and rails unknown", "objects: **ours**, hinges unknown, as for rivals"),
    (EQUAL_1, "ours, the same budget", "objects: ours, the rivals' budget"),
    (EQUAL_1, "BoDiffusion-style + object, its mean", "objects: BoDiffusion-style + object"),
    (CMU, "ours", "CMU: **ours**"),
    (CMU, "ours, typical tracking", "CMU: **ours**, typical tracking, floor and bones unknown"),
    (CMU, "BoDiffusion-style, its mean", "CMU: BoDiffusion-style"),
    (HDM05, "ours", "HDM05: **ours**"),
    (HDM05, "BoDiffusion-style, its mean", "HDM05: BoDiffusion-style"),
)
"""Rows of the page's first table: table, row, and what the page calls it."""
COMPARED = tuple(
    (LABELS[name][0], name, LABELS[name][1])
    for name in (
        "mpjpe_mm",
        "jitter_ratio",
        "foot_skate_cm_s",
        "v2v_cm",
        "symmetric_v2v_cm",
        "center_cm",
        "rotation_deg",
    )
)
"""Columns of the page's first table: heading, metric, digits."""
CLOCKS = {
    "echo_online_small_fps": "Online, from tracked points, which are given, to poses, object and contacts, beside real time"
}
"""Benchmarks: what is measured, what is given, and what it is held against."""


def page(trees: pages.Trees, speed: dict[str, list[pages.Tree]]) -> pages.Page:
    """What docs/results/echo.md says."""
    online = pages.figures_of(speed, "echo_online_small_fps")
    return pages.Page(
        title="[ECHO](../echo.md): figures",
        headline=pages.Grid(
            "Whole recordings, bodies and objects measured where they stand in the world: simulated people with objects, CMU's people "
            "and a person of another laboratory (HDM05) without. Means over seeds of the noise, ± their deviation. Rivals and ours of "
            "their budget learned alike; all are captured as means.",
            ("", *(name for name, _, _ in COMPARED)),
            pages.picked(trees, HEADLINE, COMPARED),
        ),
        held_out="People and object instances of the test split, four CMU subjects and one person of HDM05; kinds of objects are known "
        "from training. Settings were chosen on the validation split.",
        simulated="People with objects altogether, their tracked points included, which are exact. CMU's and HDM05's motion is real, "
        "their tracked points exact; with typical and poor tracking the head's path, the wrists, which are tracked from it, and the "
        "body have the errors of devices, nobody has measured the floor, and 127_32 is left out. Sizes of errors are in "
        "[simulation](simulation.md).",
        limits=echo_limits.limits(trees, OBJECTS_1, CMU, HDM05),
        full=[grid for tree in trees.values() for grid in pages.score_grids(tree, LABELS)],
        commands=pages.commands(trees),
        speed=f"{pages.times(online)} online, head and wrists tracked, active object given ({pages.machines(online)})"
        if online
        else "",
        clocks=CLOCKS,
        pictures=(
            *pages.ranked("echo"),
            ("echo_box.png", "A box that is carried, truth above and captured below, points that touch lit"),
            ("echo_table.png", "A table that is pushed: the span of median error"),
            ("echo_suitcase.png", "A suitcase that is carried: the span of median error"),
        ),
    )
