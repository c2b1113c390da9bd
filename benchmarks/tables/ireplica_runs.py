"""One recording of interactions, captured by every row of iReplica's tables and scored; and with worse sensors."""

import json
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from torch import Tensor

from benchmarks.rivals.ireplica_baselines import held_when_near, interpolated_objects, nearness, static_objects
from benchmarks.tables.seen_flat import SeenFlat
from benchmarks.tables.simulated_detections import FPS, HOD, detections, seen_hands
from wearcap.body.kinematics import local_rotations
from wearcap.cli.conf import compose
from wearcap.files import write_text
from wearcap.geometry import rotation
from wearcap.io.formats.environment import read_environment
from wearcap.recording import Motion, Recording, RecordingStore
from wearcap.recording.motion import Interactions
from wearcap.recording.timing import resampled
from wearcap.runtime.system import CaptureInput
from wearcap.scene.objects import CONTACT_CLASSES, UNKNOWN_CLASS, Environment
from wearcap.sensors.simulated import smooth_noise
from wearcap.systems.ireplica.contact_prediction import ContactPredictor
from wearcap.systems.ireplica.detected_contacts import DetectedContacts
from wearcap.systems.ireplica.object_tracker import ObjectTracker
from wearcap.systems.ireplica.pipeline import IReplica
from wearcap.systems.ireplica.scores import score_interactions

ON_BENT_PATH = (
    "as published",
    "as published, w/o contact corr.",
    "as published, our contacts",
    "as published, contacts of a simulated detector",
    "ours, on the bent path",
    "ours, on the bent path, w/o contact corr.",
)
"""Rows whose wearer is registered as documented; HPS registers the others'."""
GAPS_S = (0.0, 0.25, 0.5, 1.0, 2.0)
"""Of the paper's Table 5.4."""


@dataclass(frozen=True)
class Networks:
    """Checkpoints of contact networks."""

    ours: tuple[str, ...]
    published: tuple[str, ...]


@dataclass(frozen=True)
class RecordingRun:
    """What one recording is run with; picklable."""

    dataset: Path
    name: str
    networks: Networks
    robustness: bool
    rows: tuple[str, ...] = ()
    """Rows that are captured, without detections in the head camera's pictures; none: all."""


@dataclass(frozen=True)
class Case:
    """A recording with what is measured against."""

    recording: Recording
    environment: Environment
    source: CaptureInput

    @classmethod
    def load(cls, dataset: Path, name: str) -> "Case":
        store = RecordingStore.open(dataset)
        recording = store.load(name)
        assert recording.environment is not None
        assert recording.scene is not None
        environment = read_environment(store.root / recording.environment)
        return cls(recording, environment, CaptureInput.in_dataset(recording, store.root))


def pipeline_of(name: str, checkpoints: tuple[str, ...], jobs: int = 1) -> IReplica:
    """A pipeline config of the command line around contact networks."""
    config = compose("capture", [f"pipeline={name}", "checkpoint=null", "recording=null"]).pipeline
    if "jobs" in config.registration.get("solver", ()):
        config.registration.solver.jobs = jobs
    return instantiate(config, _convert_="all")(predictor=ContactPredictor.load(*checkpoints))


def run_recording(run: RecordingRun) -> dict[str, Any]:
    """Every row's scores of one recording, ready for JSON."""
    torch.set_num_threads(1)
    case = Case.load(run.dataset, run.name)
    ours = pipeline_of("ireplica", run.networks.ours)
    published = pipeline_of("paper/ireplica", run.networks.published)
    motion, bent = ours.registered(case.source), published.registered(case.source)
    placed = ours.placed(case.environment, case.source)
    contacts = {"ours": _contacts(ours, case), "published": _contacts(published, case)}
    seen = None if run.rows else SeenFlat.of(case.recording)
    if seen is not None:
        contacts["detections"] = detected_contacts(seen, contacts["ours"]["timestamps"])
    rows = {
        name: capture(bent if name in ON_BENT_PATH else motion)
        for name, capture in _rows(case, ours, published, contacts).items()
        if not run.rows or name in run.rows
    }
    found = {
        "recording": run.name,
        "subject": case.recording.subject,
        "location": case.recording.location,
        "rows": {name: scored(captured, case) for name, captured in rows.items()},
        "gaps": {
            str(gap): scored(_with_gap(ours.tracker, gap)(motion, contacts["ours"], placed), case) for gap in GAPS_S
        },
        "detection": {
            **{name: detection(value, case.recording) for name, value in contacts.items()},
            "nearest object by distance": detection(
                {"timestamps": motion.timestamps, **nearness(motion, {}, case.environment)}, case.recording
            ),
        },
    }
    if run.robustness:
        found["robustness"] = {name: _worse(ours, case, change) for name, change in DISTURBANCES.items()}
    return found


def _rows(
    case: Case, ours: IReplica, published: IReplica, contacts: dict[str, dict[str, Tensor]]
) -> dict[str, Callable[[Motion], Motion]]:
    """Name of a row → what captures it from HPS' motion."""
    environment, held, true = case.environment, case.recording.interactions, case.recording.object_motion
    assert held is not None
    placed = ours.placed(environment, case.source)

    def track(tracker: ObjectTracker, which: str, objects: Environment = placed) -> Callable[[Motion], Motion]:
        return lambda motion: tracker(motion, contacts[which], objects)

    changed = lambda **how: replace(ours.tracker, attachment=replace(ours.tracker.attachment, **how))  # noqa: E731
    oracle = true_contacts(held, contacts["ours"]["timestamps"])
    correction = ours.tracker.correction
    seen_rows: dict[str, Callable[[Motion], Motion]] = {}
    if "detections" in contacts:
        seen_rows = {
            "as published, contacts of a simulated detector": track(published.tracker, "detections", environment),
            "ours, contacts of a simulated detector": track(ours.tracker, "detections"),
        }
    return {
        "HPS": lambda motion: static_objects(motion, environment),
        "HPS w/ GT": lambda motion: interpolated_objects(motion, environment, held, true),
        "nearest object by distance": lambda motion: held_when_near(ours.tracker, motion, placed),
        "as published": track(published.tracker, "published", environment),
        "as published, w/o contact corr.": track(replace(published.tracker, correction=None), "published", environment),
        "as published, our contacts": track(published.tracker, "ours", environment),
        "ours": track(ours.tracker, "ours"),
        "ours, objects as measured": track(ours.tracker, "ours", environment),
        "ours, w/o contact corr.": track(replace(ours.tracker, correction=None, hands=None), "ours"),
        "ours, wearer moved, arms not": track(replace(ours.tracker, hands=None), "ours"),
        "ours, arms moved, wearer not": track(replace(ours.tracker, correction=None), "ours"),
        "ours, on the bent path": track(ours.tracker, "ours"),
        "ours, on the bent path, w/o contact corr.": track(replace(ours.tracker, correction=None, hands=None), "ours"),
        "ours, the paper's correction": track(replace(ours.tracker, correction=published.tracker.correction), "ours"),
        "ours, no fit about hinges": track(replace(ours.tracker, correction=replace(correction, hinge=None)), "ours"),  # pyright: ignore[reportArgumentType, reportCallIssue]
        "ours, published networks": track(ours.tracker, "published"),
        "ours, right hand carries": track(changed(anchor="right"), "ours"),
        "ours, the nearest of the class": track(changed(class_m=None), "ours"),
        "ours, any motion of the hand": track(changed(slip_m=None, rest_m=0.0), "ours"),
        "ours, objects not found again": track(changed(found_m=None), "ours"),
        "ours, no gaps filled": track(_with_gap(ours.tracker, 0.0), "ours"),
        "ours, classes in parallel": track(changed(one_class=False, class_m=None), "ours"),
        "ours, true contacts": lambda motion: ours.tracker(motion, oracle, placed),
    } | seen_rows


def _with_gap(tracker: ObjectTracker, gap_s: float) -> ObjectTracker:
    return replace(tracker, contact=replace(tracker.contact, gap_s=gap_s))


def _contacts(pipeline: IReplica, case: Case) -> dict[str, Tensor]:
    return pipeline.contacts(case.recording)


def detected_contacts(seen: SeenFlat, timestamps: Tensor) -> dict[str, Tensor]:
    """Contacts from simulated detections of the head camera's pictures, written to a file and read from it."""
    recording, rng = seen.recording, np.random.default_rng([41, zlib.crc32(seen.recording.name.encode())])
    assert recording.camera is not None
    assert recording.interactions is not None
    times, camera = recording.camera.timestamps, recording.camera.camera
    every = max(1, round(1 / (FPS * times.diff().median().item())))
    touching = recording.interactions.hand_contact(times[::every].contiguous()).numpy()
    found = detections(seen_hands(seen, every), touching, HOD, rng, every, (camera.width, camera.height))
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{recording.name}.json"
        write_text(path, json.dumps(found))
        source = DetectedContacts(path, segmentation=None, first_picture=0, hold_s=0.1, min_score=0.5)
        return {"timestamps": timestamps, **source(recording, timestamps)}


def true_contacts(held: Interactions, timestamps: Tensor) -> dict[str, Tensor]:
    """The truth in place of a network."""
    return {"timestamps": timestamps} | {name: held.hand_contact(timestamps, name).float() for name in CONTACT_CLASSES}


def detection(contacts: dict[str, Tensor], recording: Recording) -> dict[str, dict[str, list[float]]]:
    """Probabilities and truth per class, thinned to 20 Hz and in short numbers: pooled over recordings later.

    Contacts of no class are measured against those of any, in place of each class.
    """
    held = recording.interactions
    assert held is not None
    unknown = contacts.get(UNKNOWN_CLASS)
    every = max(1, round(1 / (20 * contacts["timestamps"].diff().median().item())))
    times = contacts["timestamps"][::every].contiguous()
    return {
        name: {
            "prob": [round(p, 4) for p in (contacts[name] if unknown is None else unknown)[::every].flatten().tolist()],
            "true": held.hand_contact(times, name if unknown is None else None).flatten().int().tolist(),
        }
        for name in CONTACT_CLASSES
    }


def scored(motion: Motion, case: Case) -> dict[str, Any]:
    return asdict(score_interactions(motion, case.recording, case.environment))


def _worse(ours: IReplica, case: Case, change: Callable[[Recording], Recording]) -> dict[str, Any]:
    """Scores with sensors that are worse: HPS and contacts are run again."""
    recording = change(case.recording)
    worse = replace(case, source=replace(case.source, recording=recording))
    contacts = ours.contacts(recording)
    placed = ours.placed(case.environment, case.source)
    captured = ours.interact(ours.registered(worse.source), contacts, placed)
    return scored(captured, case) | {"detection": detection(contacts, case.recording)}


def poses_off(degrees: float) -> Callable[[Recording], Recording]:
    """Every segment's orientation in the world off by so much more (rms), slowly varying as a suit's errors do."""

    def change(recording: Recording) -> Recording:
        suit, rng = recording.suit, np.random.default_rng(7)
        assert suit is not None
        shape = (len(suit), len(suit.skeleton) * 3)
        error = np.deg2rad(degrees) / np.sqrt(3) * smooth_noise(rng, *shape, 6.0, suit.fps)
        turn = rotation.exp(error.unflatten(-1, (len(suit.skeleton), 3)).float())
        R = local_rotations(suit.skeleton, suit.T_world_joint.R @ turn)
        return replace(recording, suit=replace(suit, R_parent_joint=R))

    return change


def places_off(metres: float) -> Callable[[Recording], Recording]:
    """Every localised camera off by so much more (rms), changing over seconds."""

    def change(recording: Recording) -> Recording:
        found, rng = recording.localization, np.random.default_rng(8)
        assert found is not None
        fps = 1 / found.timestamps.diff().median().item()
        error = metres / np.sqrt(3) * smooth_noise(rng, len(found.timestamps), 3, 4.0, fps).float()
        return replace(recording, localization=replace(found, t_world_cam=found.t_world_cam + error))

    return change


def clocks_apart(seconds: float) -> Callable[[Recording], Recording]:
    """The camera's clock late against the suit's, as claps that are heard late leave it."""

    def change(recording: Recording) -> Recording:
        found = recording.localization
        assert found is not None
        return replace(recording, localization=replace(found, timestamps=found.timestamps + seconds))

    return change


def frames_lost(share: float) -> Callable[[Recording], Recording]:
    """The suit's frames missing at random, but for the first and the last."""

    def change(recording: Recording) -> Recording:
        suit = recording.suit
        assert suit is not None
        kept = torch.rand(len(suit), generator=torch.Generator().manual_seed(9)) >= share
        kept[[0, -1]] = True
        contact = None if suit.contact_prob is None else suit.contact_prob[kept]
        return replace(
            recording,
            suit=replace(
                suit,
                timestamps=suit.timestamps[kept],
                R_parent_joint=suit.R_parent_joint[kept],
                t_world_root=suit.t_world_root[kept],
                contact_prob=contact,
            ),
        )

    return change


def at_rate(fps: float) -> Callable[[Recording], Recording]:
    def change(recording: Recording) -> Recording:
        assert recording.suit is not None
        return replace(recording, suit=resampled(recording.suit, fps))

    return change


DISTURBANCES: dict[str, Callable[[Recording], Recording]] = {
    "as simulated": lambda recording: recording,
    "poses off by 2° more": poses_off(2.0),
    "poses off by 5° more": poses_off(5.0),
    "localisation off by 2 cm more": places_off(0.02),
    "localisation off by 5 cm more": places_off(0.05),
    "camera's clock 10 ms late": clocks_apart(0.01),
    "camera's clock 33 ms late": clocks_apart(1 / 30),
    "10 % of the suit's frames lost": frames_lost(0.1),
    "20 % of the suit's frames lost": frames_lost(0.2),
    "suit at 50 Hz": at_rate(50.0),
    "suit at 30 Hz": at_rate(30.0),
}
