"""Export of contact networks to ONNX or torch.export with a sidecar, and detectors that run the exported files."""

from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from wearcap.export.exported import Run, open_exported
from wearcap.export.network import ExportReport, export_network
from wearcap.export.sidecar import header, read_sidecar, write_sidecar
from wearcap.geometry import rotation
from wearcap.recording.interactions import HANDS
from wearcap.systems.ireplica.contact_network import FRAMES, ContactNetwork
from wearcap.systems.ireplica.contact_prediction import ContactDetector
from wearcap.systems.ireplica.features import FEATURES

MAX_ERROR = 1e-5


class _MiddleFrame(nn.Module):
    """Calibrated contact probabilities of the middle frame from the features of 61 frames."""

    def __init__(self, net: ContactNetwork):
        super().__init__()
        self.net = net

    def forward(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch hand class"]:
        return self.net.probability(pose)[:, 0]


def export_contact(detector: ContactDetector, path: str | Path, format: str) -> ExportReport:
    """Write a detector's network as `path` (.onnx or .pt2) and its sidecar as the same name with .json.

    It maps `pose` "batch 61 feature" to probabilities "batch hand class". Raises what `export_network` raises.
    """
    skeleton, random = detector.features.skeleton, torch.Generator().manual_seed(0)
    turns = 0.3 * torch.randn(3, FRAMES, len(skeleton), 3, generator=random)
    example = {"pose": detector.features.encode(rotation.exp(turns))}
    report = export_network(_MiddleFrame(detector.net), example, path, format, MAX_ERROR)
    about = {
        "features": {"name": type(detector.features).__name__, **asdict(detector.features)},
        "feature_size": detector.features.size,
        "skeleton": list(skeleton.joint_names),
        "frames": FRAMES,
        "fps": detector.fps,
        "classes": list(detector.classes),
        "hands": list(HANDS),
    }
    write_sidecar(path, header("contact", report) | about)
    return report


class ExportedContact(ContactNetwork):
    """A contact network whose weights are in an exported file, run on the CPU: 61 frames in, one prediction out."""

    frames_per_pass = 1000

    def __init__(self, run: Run, classes: int):
        super().__init__(classes)
        self._run = (run,)

    def probability(self, pose: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch out hand class"]:
        windows = pose.unfold(1, FRAMES, 1).transpose(-1, -2)
        return self._run[0](pose=windows.flatten(0, 1)).unflatten(0, windows.shape[:2])


def load_exported_contact(path: str | Path) -> ContactDetector:
    """The detector of an exported model (.onnx or .pt2) and the sidecar beside it.

    Raises WearcapError when either is missing, unreadable, or does not belong to the other.
    """
    run, about = open_exported(path), read_sidecar(path, "contact")
    features = dict(about["features"])
    return ContactDetector(
        ExportedContact(run, len(about["classes"])),
        FEATURES[features.pop("name")](**features),
        tuple(about["classes"]),
        about["fps"],
    )
