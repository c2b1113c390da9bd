"""Contact sheets of ECHO's captures, truth above and capture below: one per kind of object, of the span with the median error.

python -m benchmarks.pictures.echo_pictures DATASET SPLIT CHECKPOINT OUTPUT [KIND …] [OVERRIDE …]
"""

import sys
from pathlib import Path

import torch

from wearcap.apps.viewer.picture import contact_sheet, save_png
from wearcap.apps.viewer.shown import with_objects
from wearcap.body.anny_body import anny_body
from wearcap.cli.conf import compose, load_pipeline
from wearcap.geometry.trajectory import resample
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.recording.active_objects import ActiveSpan, true_spans
from wearcap.runtime.system import CaptureInput
from wearcap.scene.objects import Environment, SceneObject
from wearcap.systems.echo.observations import ObjectShape
from wearcap.systems.echo.pipeline import Echo

FRAMES, LONGEST_S = 6, 14.0
KINDS = ("box", "table", "suitcase")


def draw(
    dataset: Path, split: str, checkpoint: str, folder: Path, kinds: tuple[str, ...], overrides: list[str]
) -> None:
    """One sheet per kind, of the span whose object is neither better nor worse placed than half of its kind's."""
    config = compose("evaluate", ["pipeline=echo", *overrides])
    pipeline, store = load_pipeline(checkpoint, config.pipeline, "cpu"), RecordingStore.open(dataset)
    assert isinstance(pipeline, Echo)
    reader = pipeline.reader()
    found: dict[str, list[tuple[float, int, ActiveSpan]]] = {kind: [] for kind in kinds}
    shown = [
        (source, spans)
        for source in (CaptureInput(store.load(name), store.root) for name in store.names(split))
        if (spans := _spans(pipeline, source, kinds))
    ]
    sources = [source for source, _ in shown]
    motions = pipeline.motions(sources, [0] * len(sources))
    for number, (source, spans) in enumerate(shown):
        for span, item in spans:
            error = _apart(motions[number], source.recording, span, reader(item))
            found[item.category].append((error, number, span))
    for kind, spans in found.items():
        if not spans:
            print(f"{kind}: none in this split")
            continue
        error, number, span = sorted(spans, key=lambda one: one[0])[len(spans) // 2]
        recording, motion = sources[number].recording, motions[number]
        environment = pipeline.objects(sources[number])
        assert environment is not None
        save_png(
            folder / f"echo_{kind}.png",
            sheet(with_objects(recording, environment), motion, environment, span, recording.shape),
        )
        print(
            f"{kind}: {recording.name}, {span.object}, {span.start_s:.1f} to {span.stop_s:.1f} s, {100 * error:.0f} cm off, the median of {len(spans)}"
        )


def _spans(echo: Echo, source: CaptureInput, kinds: tuple[str, ...]) -> list[tuple[ActiveSpan, SceneObject]]:
    """With objects of some kinds."""
    environment = echo.objects(source)
    assert environment is not None
    spans = [(span, environment.by_name(span.object)) for span in true_spans(source.recording)]
    return [(span, item) for span, item in spans if item.category in kinds]


def _apart(motion: Motion, recording: Recording, span: ActiveSpan, shape: ObjectShape) -> float:
    """Mean distance of points of an object's surface from where they were in truth, during one span (m)."""
    points = []
    for tracks in (recording.object_motion, motion.object_motion):
        track = tracks[span.object]
        times = torch.arange(span.start_s, span.stop_s, 0.2, dtype=torch.float64)
        T = resample(track, times.clamp(track.timestamps[0].item(), track.timestamps[-1].item())).T_world_body
        points.append(shape.centred(T).to(torch.float32)[:, None] @ shape.cloud[::10])
    return (points[0] - points[1]).norm(dim=-1).mean().item()


def sheet(truth: Motion | None, motion: Motion, environment: Environment, span: ActiveSpan, shape: dict[str, float]):
    """Truth and capture from before the touch to behind the release, with nothing but the object."""
    assert truth is not None
    stop = min(span.stop_s - 1.0, span.start_s + 1.0 + LONGEST_S)
    times = torch.linspace(span.start_s + 1.0, stop, FRAMES, dtype=torch.float64)
    frames = torch.searchsorted(truth.timestamps, times).clamp(0, len(truth) - 1).tolist()
    return contact_sheet(
        {"truth": truth, "captured": motion},
        frames,
        columns=FRAMES,
        size=(300, 320),
        body=anny_body(motion.skeleton, shape or None),
        environment=Environment((environment.by_name(span.object),)),
        distance=4.2,
    )


if __name__ == "__main__":
    static_threshold = sys.argv[5:]
    chosen = tuple(word for word in static_threshold if "=" not in word) or KINDS
    draw(
        Path(sys.argv[1]),
        sys.argv[2],
        sys.argv[3],
        Path(sys.argv[4]),
        chosen,
        [word for word in static_threshold if "=" in word],
    )
