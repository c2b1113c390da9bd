"""What ECHO's tables capture: rows on whole recordings, with objects, with parts of the truth observed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.rivals import compose
from benchmarks.tables.sensed import GIVEN, sensed
from wearcap.cli.conf import load_pipeline
from wearcap.errors import require_choice
from wearcap.geometry.trajectory import Trajectory
from wearcap.recording import Motion, RecordingStore
from wearcap.runtime.system import CaptureInput
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.observations import BatchItem, Observed, Scenario, batch_item_of
from wearcap.systems.echo.pipeline import Echo
from wearcap.systems.echo.scores import Truth
from wearcap.tracking.head_path import head_path
from wearsim.recordings.measured import EnvironmentErrors, as_measured


@dataclass(frozen=True)
class Method:
    """A row: a checkpoint, how it captures, and what is observed."""

    name: str
    checkpoint: str
    pipeline: tuple[str, ...] = ("pipeline=echo",)
    observed: tuple[str, float] | None = None
    """A modality, and the share of its frames that are given."""
    height_off_m: float | None = None
    """How far the height that the wearer gives is off (m); None: the wearer's own bones are given."""
    sensors: str = GIVEN
    """Preset of the errors of head, wrists and body (`WEARABLES`), with an unknown floor; or `GIVEN`."""
    measured: bool = False
    """Whether objects, hinges and rails are where people measure them (`as_measured`), instead of where they are."""
    others: tuple[str, ...] = ()
    """Checkpoints of the same training with other seeds, which the row is the mean of, too."""


def pipeline_of(method: Method) -> Echo:
    pipeline = load_pipeline(method.checkpoint, compose("evaluate", list(method.pipeline)).pipeline, "cpu")
    assert isinstance(pipeline, Echo)
    return pipeline


@dataclass(frozen=True, eq=False)
class Captured:
    """One recording, captured with one seed."""

    name: str
    seed: int
    motion: Motion
    truth: Truth
    item: BatchItem


def captured(
    method: Method, store: RecordingStore, names: Sequence[str], seeds: Sequence[int], items: int
) -> Iterator[Captured]:
    """Every recording with every seed, `items` of them at a time: those of like length side by side, so that none waits
    long for another."""
    echo = pipeline_of(method)
    reader = echo.reader()
    ordered = sorted(names, key=lambda name: store.entries[name].frames)
    jobs = [(name, seed) for name in ordered for seed in seeds]
    for start in range(0, len(jobs), items):
        batch = jobs[start : start + items]
        given = {name: sensed(store.load(name), method.sensors, method.height_off_m) for name, _ in batch}
        observed_parts = {
            name: scenario_of(echo, CaptureInput(part, store.root), method.measured) for name, part in given.items()
        }
        scenarios = [_observing(method, echo, observed_parts[name], store.root, seed) for name, seed in batch]
        motions = echo.capture_scenarios(scenarios, [seed for _, seed in batch])
        for (name, seed), motion in zip(batch, motions):
            scenario = observed_parts[name]
            item = batch_item_of(scenario, head_path(scenario.recording, echo.model.skeleton, echo.fps), reader)
            true = scenario.recording if method.sensors == GIVEN else store.load(name)
            yield Captured(name, seed, motion, echo.truth(motion, CaptureInput(true, store.root)), item)


def scenario_of(echo: Echo, source: CaptureInput, measured: bool) -> Scenario:
    """The recording with the objects of its own file, exactly or as `measured`: the same errors in every run."""
    environment = echo.objects(source)
    if measured and environment is not None:
        rng = np.random.default_rng([7, *source.recording.name.encode()])
        environment = as_measured(environment, EnvironmentErrors(), rng)
    return echo.scenario(source.recording, environment)


def _observing(method: Method, echo: Echo, scenario: Scenario, root: Path, seed: int) -> Scenario:
    """The scenario with what the row observes, other frames for every seed."""
    if method.observed is None:
        return scenario
    recording = scenario.recording
    path = head_path(recording, echo.model.skeleton, echo.fps)
    blank = Motion(path.timestamps, path.skeleton, *_still(len(path.timestamps), len(path.skeleton)))
    truth = echo.truth(blank, CaptureInput(recording, root))
    return replace(scenario, observed=observed_share(truth, *method.observed, seed))


def observed_share(truth: Truth, modality: str, share: float, seed: int) -> Observed:
    """Ground truth of one modality in a random share of the frames, drawn uniformly (ECHO Tables 3, S2).

    Raises WearcapError for an unknown modality.
    """
    require_choice(modality, MODALITIES, f"no modality {modality!r}")
    rng = np.random.default_rng([17, seed])
    count = len(truth.motion)
    chosen = np.sort(rng.choice(count, max(1, round(share * count)), replace=False))
    take = torch.from_numpy(chosen)
    times = truth.motion.timestamps[take]
    if modality == "human":
        R, t = truth.motion.R_parent_joint[take], truth.motion.t_world_root[take]
        return Observed(motion=Motion(times, truth.motion.skeleton, R, t))
    if modality == "object":
        tracks = {}
        for number, shape in enumerate(truth.objects):
            rows = take[truth.active[take] == number]
            pose = shape.of_mesh(truth.T_world_object[number][rows])
            tracks[shape.name] = Trajectory(truth.motion.timestamps[rows], pose.R, pose.t)
        return Observed(object_motion=tracks)
    contact = torch.cat([truth.touch.float(), truth.foot_contact], 1)[take]
    return Observed(contact_times=times, contact=contact)


def _still(count: int, joints: int):
    return torch.eye(3).repeat(count, joints, 1, 1), torch.zeros(count, 3)
