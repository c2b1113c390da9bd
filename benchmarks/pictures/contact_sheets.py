"""One picture of a system's worst, median and best recording of a data set, truth above and capture below.

    python benchmarks/contact_sheets.py SYSTEM [--dataset datasets/cmu] [--split test] [--output docs]
    python benchmarks/contact_sheets.py SYSTEM --walk FILE [--checkpoint FILE] [--output docs]

SYSTEM is hmd2, mocap_every or echo, with its shared checkpoint and default pipeline; recordings are ranked by the joints'
mean error over whole recordings, without those of less than `LEAST_S` and those whose file is wrong (`UPSIDE_DOWN`). Feet and other points in contact are marked by
dots. Writes OUTPUT/SYSTEM_DATASET.png, which the results' pages show.

With --walk, somebody's own recording without a truth, captured at no given height: three walking cycles from the side, of
the most, the median and the least bent knee in stance, in OUTPUT/SYSTEM_FILE.png; beside it as JSON, also printed, the
knee in stance, how high the lower toe is over the recording's floor while walking, and the estimated height.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from PIL import Image
from torch import Tensor

from benchmarks.tables.sensed import GIVEN, SensedStore
from benchmarks.tables.tabling import UPSIDE_DOWN
from wearcap.apps.viewer.picture import VIEW_RAD, captioned, contact_sheet, save_png
from wearcap.body.skeleton import xsens23
from wearcap.cli.conf import compose, load_pipeline
from wearcap.errors import WearcapError
from wearcap.evaluation.evaluate import evaluate
from wearcap.files import write_text
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate_clamped, nearest_frames
from wearcap.metrics.gait import STANCE, cycle_times, knees_over, walking_scores
from wearcap.metrics.physics import foot_points
from wearcap.metrics.table import Row
from wearcap.reading import load
from wearcap.recording import Motion, Recording
from wearcap.recording.store import dataset_folder
from wearcap.runtime.system import CaptureInput, System
from wearcap.runtime.walked_stature import with_walked_stature
from wearcap.scene.floor import estimate_floor
from wearcap.tracking.stature import with_stature

SENSORS = {"hmd2": "typical", "mocap_every": "typical", "echo": GIVEN}
"""Errors of heads and watches, as in the systems' tables."""
LEAST_S = 2.0
"""Shortest recording (s) that is shown."""
COLUMNS, SIZE, BAND = 7, (170, 200), 22


def sheet(pipeline: System, store: SensedStore, split: str) -> np.ndarray:
    """The sheet, "height width 3"."""
    captured: dict[str, Motion] = {}

    def measure(motion: Motion, source: CaptureInput, seed: int) -> Row:
        captured[source.recording.name] = motion
        return pipeline.score(motion, CaptureInput(store.true(source.recording.name), store.root), seed)

    names = [
        name for name in store.names(split) if store.entries[name].duration_s >= LEAST_S and name not in UPSIDE_DOWN
    ]
    rows = list(evaluate(pipeline, store, names, (0,), measure=measure))
    errors = {row.recording: row.scores.get("mpjpe_cm", 0.1 * row.scores.get("mpjpe_mm", 0.0)) for row in rows}
    ranked = sorted(errors, key=errors.__getitem__)
    shown = {"worst": ranked[-1], f"median of {len(ranked)}": ranked[len(ranked) // 2], "best": ranked[0]}
    bands = []
    for what, name in shown.items():
        truth = store.true(name).motion
        assert truth is not None
        panels = contact_sheet({"truth": truth, "captured": captured[name]}, columns=COLUMNS, size=SIZE)
        text = f"{what}: {name}, {errors[name]:.1f} cm"
        bands += _titled(panels, text)
        print(text)
    return np.concatenate(bands)


def _titled(panels: np.ndarray, text: str) -> list[np.ndarray]:
    """A line of text, and panels below it."""
    title = np.full((BAND, panels.shape[1], 3), 255, np.uint8)
    return [np.asarray(captioned(title, text)), panels]


def walk(pipeline: System, file: Path) -> tuple[np.ndarray, dict[str, float]]:
    """Cycles of a recorded walk from the side, "height width 3", and its figures. Raises WearcapError where the capture
    does not walk."""
    recording, stature = with_stature(load(file).recording, xsens23())
    source = CaptureInput.in_dataset(recording, dataset_folder(file))
    source, stature = with_walked_stature(pipeline, source, stature, xsens23())
    recording, motion = source.recording, pipeline(source)
    both = cycle_times(motion)
    cycles, knees = torch.cat(both), torch.cat(knees_over(motion, both))[:, STANCE].mean(1)
    if not len(cycles):
        raise WearcapError(
            "no cycle of straight, level walking in the capture", file, "a recording of somebody who walks"
        )
    figures = {} if stature is None else {"stature_m": stature.height_m, "stature_deviation_m": stature.deviation_m}
    figures |= {"cycles": len(cycles), **walking_scores(motion, both), **_toes_cm(motion, recording, cycles)}
    ranked = knees.argsort(descending=True).tolist()
    bands = []
    for what, number in zip(("most", "median", "least"), (ranked[0], ranked[len(ranked) // 2], ranked[-1])):
        title = f"{what} bent of {len(ranked)} cycles: {knees[number]:.0f} deg in stance"
        bands += _titled(_from_aside(motion, cycles[number]), title)
    return np.concatenate(bands), {name: round(float(value), 3) for name, value in figures.items()}


def _from_aside(motion: Motion, cycle: Float64[Tensor, "point"]) -> np.ndarray:
    """Frames of one cycle, seen from the walker's left or right."""
    shown = cycle[torch.linspace(0, len(cycle) - 1, COLUMNS).long()]
    frames = nearest_frames(motion.timestamps, shown).tolist()
    ahead = motion.t_world_root[frames[-1]] - motion.t_world_root[frames[0]]
    turn = torch.tensor(VIEW_RAD - math.pi / 2) - torch.atan2(ahead[1], ahead[0])
    turned = motion.moved(Rigid(rotation.about_axis("z", turn), torch.zeros(3)))
    return contact_sheet({"": turned}, frames, columns=COLUMNS, size=SIZE)


def _toes_cm(motion: Motion, recording: Recording, cycles: Float64[Tensor, "cycle point"]) -> dict[str, float]:
    """Median, 5th and 95th percentile of the lower toe's height (cm) over the floor below the recording's points, over all
    frames in `cycles`; nothing of a recording without points."""
    if recording.points is None or recording.head is None:
        return {}
    below = estimate_floor(recording.points.points_world, recording.head.t_world_device).height
    floor: Float[Tensor, "time"] = interpolate_clamped(recording.head.timestamps, below, motion.timestamps)
    toes = foot_points(motion.skeleton, motion.T_world_joint)[:, :, 1, 2].amin(1)
    times = motion.timestamps[:, None]
    walked = ((times >= cycles[:, 0]) & (times <= cycles[:, -1])).any(1)
    low, middle, high = 100 * (toes - floor)[walked].quantile(torch.tensor([0.05, 0.5, 0.95]))
    return {"toe_cm": middle.item(), "toe_5_cm": low.item(), "toe_95_cm": high.item()}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("system", choices=SENSORS)
    parser.add_argument("--dataset", type=Path, default=Path("datasets/cmu"))
    parser.add_argument("--split", default="test")
    parser.add_argument("--output", type=Path, default=Path("docs"))
    parser.add_argument("--checkpoint", help="another one than the shared")
    parser.add_argument("--walk", type=Path, metavar="FILE", help="a recording, as `wearcap capture` takes it")
    options = parser.parse_args(arguments)
    config = compose("evaluate", [f"pipeline={options.system}"]).pipeline
    pipeline = load_pipeline(options.checkpoint or options.system, config, "cpu")
    output = options.output / f"{options.system}_{(options.walk or options.dataset).name}.png"
    if options.walk is None:
        picture = sheet(pipeline, SensedStore.open(options.dataset, SENSORS[options.system]), options.split)
    else:
        picture, figures = walk(pipeline, options.walk)
        about = {"recording": options.walk.name, "checkpoint": options.checkpoint or options.system, **figures}
        write_text(output.with_suffix(".json"), json.dumps(about, indent=1) + "\n")
        print(json.dumps(about))
    palette = Image.fromarray(picture).quantize(64, method=Image.Quantize.MEDIANCUT).convert("RGB")
    save_png(output, np.asarray(palette))
