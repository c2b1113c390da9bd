"""Contact networks as exported graphs, and detectors that run the exported files."""

from dataclasses import asdict
from pathlib import Path

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.files import write_text
from wearcap.geometry import rotation
from wearcap.recording import Recording
from wearcap.recording.motion import HANDS
from wearcap.runtime.graphs import Call, Exports, Graph, Rate, Run
from wearcap.systems.ireplica.contact_prediction import (
    FRAMES,
    ContactDetector,
    ContactNetwork,
    ContactPredictor,
    ContactStream,
)
from wearcap.systems.ireplica.features import FEATURES, pose_frames
from wearcap.systems.ireplica.pipeline import IReplica


def exports(pipeline: IReplica) -> Exports:
    """The contact network, from `pose` "batch 61 feature" to the middle frame's probabilities "batch hand class".

    Raises WearcapError for a pipeline with several of them, or with none.
    """
    predictor = pipeline.predictor
    detectors = predictor.detectors if isinstance(predictor, ContactPredictor) else ()
    if len(detectors) != 1:
        raise WearcapError(f"{len(detectors)} contact networks", expected="one, of one checkpoint")
    detector = detectors[0]
    skeleton, random = detector.features.skeleton, torch.Generator().manual_seed(0)
    turns = 0.3 * torch.randn(3, FRAMES, len(skeleton), 3, generator=random)
    graph = Graph(Call(detector.net, "middle_probability"), {"pose": detector.features.encode(rotation.exp(turns))})
    about = {
        "features": {"name": type(detector.features).__name__, **asdict(detector.features)},
        "feature_size": detector.features.size,
        "skeleton": list(skeleton.joint_names),
        "frames": FRAMES,
        "fps": detector.fps,
        "classes": list(detector.classes),
        "hands": list(HANDS),
    }
    return Exports("ireplica", {"network": graph}, about, max_error=1e-5)


class _ExportedContact(ContactNetwork):
    """A contact network whose weights are in an exported file, run on the CPU: 61 frames in, one prediction out."""

    frames_per_pass = 1000

    def __init__(self, run: Run, classes: int):
        super().__init__(classes)
        self._run = (run,)

    def probability(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        windows = pose.unfold(1, FRAMES, 1).transpose(-1, -2)
        return self._run[0](pose=windows.flatten(0, 1)).unflatten(0, windows.shape[:2])


class _ExportedDetector(ContactDetector):
    """The detector of an exported model."""

    def write(self, recording: Recording, path: str | Path) -> None:
        """Predict hand contact frame by frame (latency 30 frames, state the last 61), and write times and probabilities
        as a table (.csv). Raises WearcapError for a recording without poses."""
        motion = recording.suit or recording.motion
        if motion is None:
            raise WearcapError("this recording has no poses", where=recording.name, expected="a suit, or a motion")
        times, R = pose_frames(motion, self.features.skeleton, self.fps)
        stream = ContactStream((self,), self.features.skeleton)
        predictions = [found for frame in R if (found := stream.push(frame)) is not None] + stream.finish()
        header = ["time_s", *(f"{hand}_{name}" for name in self.classes for hand in HANDS)]
        rows = [
            [f"{time:.6f}", *(f"{p:.7f}" for p in torch.cat([found[name] for name in self.classes]).tolist())]
            for time, found in zip(times.tolist(), predictions)
        ]
        write_text(path, "".join(",".join(row) + "\n" for row in [header, *rows]))


class Sidecar(msgspec.Struct):
    """What running an exported network takes of its sidecar."""

    features: dict[str, str | bool]
    classes: tuple[str, ...]
    fps: Rate


def from_export(runs: dict[str, Run], weights: dict[str, dict[str, Tensor]], about: Sidecar) -> _ExportedDetector:
    """The detector of an exported model."""
    features = dict(about.features)
    encoder = FEATURES[features.pop("name")](**features)
    return _ExportedDetector(_ExportedContact(runs["model"], len(about.classes)), encoder, about.classes, about.fps)
