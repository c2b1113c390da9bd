"""Prediction of hand contact from poses alone (thesis §5.3.2), for whole recordings and frame by frame."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.geometry.trajectory import interpolate
from wearcap.models.build import build
from wearcap.models.checkpoint import read_checkpoint
from wearcap.recording import Motion
from wearcap.systems.ireplica.features import FEATURES, PoseFeatures, in_skeleton, pose_frames, retarget_skeleton

REACH = 30
"""Number of context frames (at 60 Hz) on each side of a predicted frame."""
FRAMES = 2 * REACH + 1


class ContactNetwork(nn.Module):
    """Maps poses of consecutive frames to contact logits per hand (left, right) and class of interaction.

    Of `time` frames, those from `REACH` to `time - REACH - 1` have a prediction; the others lack context.
    """

    temperature: Tensor
    frames_per_pass: int
    """Number of predicted frames that are best computed in one pass."""

    def __init__(self, classes: int):
        super().__init__()
        self.classes = classes
        self.register_buffer("temperature", torch.ones(classes))

    def forward(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        raise NotImplementedError

    def probability(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        """Calibrated probabilities: sigmoid of the logits divided by a temperature fitted on validation data."""
        return (self(pose) / self.temperature).sigmoid()

    def middle_probability(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch hand class"]:
        """Calibrated probabilities of the middle one of 61 frames."""
        return self.probability(pose)[:, 0]

    def normalize_on(self, pose: Float[Tensor, "batch time feature"]) -> None:
        """Set the statistics that normalise the inputs; the thesis's network has none."""


NETWORKS = ("ContactTransformer", "ContactSequence")
"""Names of the subclasses that a checkpoint may hold."""


@dataclass(frozen=True)
class ContactDetector:
    """A contact network with its input features, frame rate, and classes of interaction."""

    net: ContactNetwork
    features: PoseFeatures
    classes: tuple[str, ...]
    fps: float = 60.0

    @classmethod
    def load(cls, path: str | Path) -> "ContactDetector":
        """Load the detector of a checkpoint of `wearcap train`. Raises WearcapError when it holds another model."""
        config, state = read_checkpoint(path)
        model = config["model"]
        net, features, classes, fps = (model.get(key) for key in ("net", "features", "classes", "fps"))
        kinds = [
            str(part.get("_target_", "")).rpartition(".")[2] if isinstance(part, dict) else ""
            for part in (net, features)
        ]
        if (
            kinds[0] not in NETWORKS
            or kinds[1] not in FEATURES
            or not (isinstance(classes, list) and isinstance(fps, int | float))
        ):
            what = f"a checkpoint of {kinds[0] or 'another model'}"
            raise WearcapError(what, where=path, expected=f"a contact network: {' or '.join(NETWORKS)}")
        encoder = FEATURES[kinds[1]](**{key: value for key, value in features.items() if key != "_target_"})
        net = {key: value for key, value in net.items() if key != "_partial_"}
        network = build(net | {"inputs": encoder.size, "classes": len(classes)}, state, path, prefix="net.")
        return cls(network, encoder, tuple(classes), fps)

    def probability(self, feature: Float[Tensor, "time feature"]) -> Float[Tensor, "out hand class"]:
        """Probabilities of all frames but the first and last `REACH`, in passes of `frames_per_pass` frames."""
        step, out = self.net.frames_per_pass, len(feature) - 2 * REACH
        device = self.net.temperature.device
        passes = [
            self.net.probability(feature[None, start : min(start + step, out) + 2 * REACH].to(device))[0].cpu()
            for start in range(0, out, step)
        ]
        return torch.cat(passes)


class ContactPredictor:
    """Predicts contact probabilities per class of interaction, hand and frame of a motion, by one or more detectors.
    The motion is padded at both ends with its first and last frame."""

    def __init__(self, *detectors: ContactDetector):
        names = [name for detector in detectors for name in detector.classes]
        if not names or len(set(names)) < len(names):
            what = f"contact networks for {', '.join(names) or 'nothing'}"
            raise WearcapError(what, expected="one network for each class of interaction")
        self.detectors, self.classes = detectors, tuple(names)
        for detector in detectors:
            detector.net.eval()

    @classmethod
    def load(cls, *checkpoints: str | Path) -> "ContactPredictor":
        """Load detectors from checkpoints of `wearcap train`. Raises WearcapError for any other file."""
        return cls(*(ContactDetector.load(path) for path in checkpoints))

    @torch.inference_mode()
    def __call__(self, motion: Motion) -> dict[str, Float[Tensor, "time hand"]]:
        """Contact probabilities by class at the frames of `motion`, for any frame rate and skeleton. Raises
        WearcapError for poses that are not numbers."""
        if not len(motion):
            return {name: torch.zeros(0, 2) for name in self.classes}
        result: dict[str, Tensor] = {}
        for detector in self.detectors:
            times, R = pose_frames(motion, detector.features.skeleton, detector.fps)
            feature = detector.features.encode(R)
            ends = feature[:1].expand(REACH, -1), feature[-1:].expand(REACH, -1)
            prob = detector.probability(torch.cat([ends[0], feature, ends[1]]))
            if times is not motion.timestamps:
                prob = interpolate(times, prob, motion.timestamps)
            result |= dict(zip(detector.classes, prob.unbind(-1)))
        return result

    def stream(self, skeleton: Skeleton) -> "ContactStream":
        """Streaming prediction for poses of `skeleton` at the networks' frame rate."""
        return ContactStream(self.detectors, skeleton)


class ContactStream:
    """Predicts contact frame by frame with a latency of `REACH` frames; its state is the last 61 frames' features."""

    def __init__(self, detectors: tuple[ContactDetector, ...], skeleton: Skeleton):
        self._detectors, self._skeleton = detectors, skeleton
        self._targets = [retarget_skeleton(skeleton, detector.features.skeleton) for detector in detectors]
        self._state: list[Tensor] = []
        self._frames = 0

    @torch.inference_mode()
    def push(self, R_parent_joint: Float[Tensor, "joint 3 3"]) -> dict[str, Float[Tensor, "hand"]] | None:
        """Add a pose; returns the prediction for the frame `REACH` before it, None while there is no such frame. Raises
        WearcapError for a pose that is not a number; the state is then unchanged."""
        if not R_parent_joint.isfinite().all():
            raise WearcapError(f"the pose of frame {self._frames} is not a number", expected="a pose in every frame")
        features = [
            detector.features.encode(in_skeleton(self._skeleton, target, R_parent_joint[None]))
            for detector, target in zip(self._detectors, self._targets)
        ]
        return self._advance(features)

    @torch.inference_mode()
    def finish(self) -> list[dict[str, Float[Tensor, "hand"]]]:
        """Return the remaining predictions, repeating the last frame."""
        last = [state[-1:] for state in self._state]
        predictions = [self._advance(last) for _ in range(REACH)]
        return [prediction for prediction in predictions if prediction is not None]

    def _advance(self, features: list[Tensor]) -> dict[str, Float[Tensor, "hand"]] | None:
        if not self._state:
            self._state = [feature.expand(FRAMES, -1) for feature in features]
        self._state = [torch.cat([s[1:], f]) for s, f in zip(self._state, features)]
        self._frames += 1
        if self._frames <= REACH:
            return None
        prediction = {}
        for detector, state in zip(self._detectors, self._state):
            prediction |= dict(zip(detector.classes, detector.probability(state)[0].unbind(-1)))
        return prediction
