"""Contact sheets of ECHO's captures, truth above and capture below: one per kind of object, of its longest act.

python benchmarks/echo_pictures.py DATASET SPLIT CHECKPOINT OUTPUT [KIND …] [OVERRIDE …]
"""

import sys
from pathlib import Path

import torch

from wearcap.body.anny_body import anny_body
from wearcap.cli.conf import compose
from wearcap.cli.load import load_pipeline
from wearcap.pipelines.echo import Echo
from wearcap.pipelines.echo_dataset import EchoOnDataset
from wearcap.recording import Motion, RecordingStore
from wearcap.recording.acts import Act, true_acts
from wearcap.scene.environment import Environment
from wearcap.viewer.objects import with_objects
from wearcap.viewer.picture import contact_sheet, save_png

FRAMES, LONGEST_S = 6, 14.0
KINDS = ("box", "table", "suitcase")


def draw(dataset: Path, split: str, checkpoint: str, folder: Path, kinds: tuple[str, ...], overrides: list[str]) -> None:  # fmt: skip
    """One sheet per kind, of the act with it that is longest."""
    config = compose("evaluate", ["pipeline=echo", *overrides])
    pipeline, store = load_pipeline(checkpoint, config.pipeline, "cpu"), RecordingStore.open(dataset)
    assert isinstance(pipeline, Echo)
    on, best = EchoOnDataset(pipeline, store.root), {}
    for name in store.names(split):
        recording = store.load(name)
        environment = on.environment(recording)
        assert environment is not None
        for act in true_acts(recording):
            kind = environment.by_name(act.object).category
            if kind in kinds and act.stop_s - act.start_s > best.get(kind, (0.0,))[0]:
                best[kind] = (act.stop_s - act.start_s, name, act)
    for kind, (_, name, act) in best.items():
        recording = store.load(name)
        motion = on.capture([recording], [0])[0]
        environment = on.environment(recording)
        assert environment is not None
        save_png(folder / f"{kind}.png", sheet(with_objects(recording, environment), motion, environment, act, recording.shape))  # fmt: skip
        print(f"{kind}: {name}, {act.object}, {act.start_s:.1f} to {act.stop_s:.1f} s")


def sheet(truth: Motion | None, motion: Motion, environment: Environment, act: Act, shape: dict[str, float]):
    """Truth and capture from before the touch to behind the release, with nothing but the object."""
    assert truth is not None
    stop = min(act.stop_s - 1.0, act.start_s + 1.0 + LONGEST_S)
    times = torch.linspace(act.start_s + 1.0, stop, FRAMES, dtype=torch.float64)
    frames = torch.searchsorted(truth.timestamps, times).clamp(0, len(truth) - 1).tolist()
    return contact_sheet(
        {"truth": truth, "captured": motion}, frames, columns=FRAMES, size=(300, 320),
        body=anny_body(motion.skeleton, shape or None), environment=Environment((environment.by_name(act.object),)),
        distance=4.2,
    )  # fmt: skip


if __name__ == "__main__":
    rest = sys.argv[5:]
    chosen = tuple(word for word in rest if "=" not in word) or KINDS
    draw(Path(sys.argv[1]), sys.argv[2], sys.argv[3], Path(sys.argv[4]), chosen, [word for word in rest if "=" in word])  # fmt: skip
