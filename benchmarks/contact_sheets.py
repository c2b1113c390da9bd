"""One picture of a system's worst, median and best recording of a data set, truth above and capture below.

    python benchmarks/contact_sheets.py SYSTEM [--dataset datasets/cmu] [--split test] [--output docs]

SYSTEM is hmd2, mocap_every or echo, with its shared checkpoint and default pipeline; recordings are ranked by the joints'
mean error over whole recordings, without those of less than `LEAST_S` and those whose file is wrong (`UPSIDE_DOWN`). Feet and other points in contact are marked by
dots. Writes OUTPUT/SYSTEM_DATASET.png, which the results' pages show.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from sensed import GIVEN, SensedStore
from tabling import UPSIDE_DOWN

from wearcap.cli.conf import compose, load_pipeline
from wearcap.evaluation.evaluate import evaluate
from wearcap.metrics.table import Row
from wearcap.recording import Motion
from wearcap.runtime.system import CaptureInput
from wearcap.viewer.picture import captioned, contact_sheet, save_png

SENSORS = {"hmd2": "typical", "mocap_every": "typical", "echo": GIVEN}
"""Errors of heads and watches, as in the systems' tables."""
LEAST_S = 2.0
"""Shortest recording (s) that is shown."""
COLUMNS, SIZE, BAND = 7, (170, 200), 22


def sheet(system: str, store: SensedStore, split: str) -> np.ndarray:
    """The sheet, "height width 3"."""
    pipeline = load_pipeline(system, compose("evaluate", [f"pipeline={system}"]).pipeline, "cpu")
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
        title = np.full((BAND, panels.shape[1], 3), 255, np.uint8)
        text = f"{what}: {name}, {errors[name]:.1f} cm"
        bands += [np.asarray(captioned(title, text)), panels]
        print(text)
    return np.concatenate(bands)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("system", choices=SENSORS)
    parser.add_argument("--dataset", type=Path, default=Path("datasets/cmu"))
    parser.add_argument("--split", default="test")
    parser.add_argument("--output", type=Path, default=Path("docs"))
    options = parser.parse_args()
    store = SensedStore.open(options.dataset, SENSORS[options.system])
    picture = Image.fromarray(sheet(options.system, store, options.split))
    palette = picture.quantize(64, method=Image.Quantize.MEDIANCUT).convert("RGB")
    save_png(options.output / f"{options.system}_{options.dataset.name}.png", np.asarray(palette))


if __name__ == "__main__":
    main()
