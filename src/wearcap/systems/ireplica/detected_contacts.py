"""Contacts from pictures in place of a network (thesis §5.4.3: "iReplica w/ HOD", "iReplica w/ VISOR").

Detectors and annotators judge every picture of the head camera alone, and name no class of interaction.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.io.formats.hand_detections import HandDetections, read_hand_detections, read_vertex_contacts
from wearcap.recording import Recording
from wearcap.scene.objects import UNKNOWN_CLASS

_SUFFIXES = (".json", ".csv", ".csv.gz", ".npz")


@dataclass(frozen=True)
class DetectedContacts:
    """Contact probabilities from files of a detector."""

    files: str | Path
    """A file, or a folder with a file for each recording: NAME.json, .csv or .npz (`io.formats.hand_detections`)."""
    segmentation: str | Path | None
    """Vertices of the hands, for contacts of a body's vertices (.npz)."""
    first_picture: int
    """Number of the camera's first picture."""
    hold_s: float
    """Longest time (s) for which a picture's contacts stand for those before and after it."""
    min_score: float
    """Least confidence in a hand."""

    def file(self, recording: Recording) -> Path:
        """File of a recording. Raises WearcapError where there is none."""
        given = Path(self.files)
        named = [given / f"{recording.name}{suffix}" for suffix in _SUFFIXES] if given.is_dir() else [given]
        found = next((path for path in named if path.is_file()), None)
        if found is None:
            expected = " or ".join(path.name for path in named)
            raise WearcapError(f"no detections for {recording.name}", where=given, expected=expected)
        return found

    def __call__(self, recording: Recording, timestamps: Float64[Tensor, "time"]) -> dict[str, Tensor]:
        """Contact probability of each hand by class of interaction, which is unknown.

        Raises WearcapError for a recording without a camera, a file that does not belong to it, and as its reader does.
        """
        path = self.file(recording)
        if recording.camera is None:
            raise WearcapError(
                "no camera whose pictures were looked at", where=recording.name, expected="a head camera"
            )
        found = self._read(path)
        index, count = found.pictures - self.first_picture, len(recording.camera.timestamps)
        if index[0] < 0 or index[-1] >= count:
            last = self.first_picture + count - 1
            what = f"pictures {int(found.pictures[0])} to {int(found.pictures[-1])}"
            fix = "Give the number of the camera's first picture: pipeline.detections.first_picture=N."
            raise WearcapError(what, path, f"{self.first_picture} to {last}, as the camera of {recording.name}", fix)
        times = recording.camera.timestamps[index]
        return {UNKNOWN_CLASS: contacts_at(found, times, timestamps, self.hold_s)}

    def _read(self, path: Path) -> HandDetections:
        if path.suffix != ".npz":
            return read_hand_detections(path, self.min_score)
        if self.segmentation is None:
            fix = "Give SMPL's public segmentation (JSON) as pipeline.detections.segmentation=FILE."
            raise WearcapError("contacts of a body's vertices without the hands' ones", path, fix=fix)
        return read_vertex_contacts(path, self.segmentation)


def contacts_at(
    detections: HandDetections,
    picture_times: Float64[Tensor, "picture"],
    timestamps: Float64[Tensor, "time"],
    hold_s: float,
) -> Float[Tensor, "time hand"]:
    """Contact of the nearest picture in which a hand was seen, 0 where that is more than `hold_s` away."""
    prob = torch.zeros(len(timestamps), detections.seen.shape[1])
    for hand in range(detections.seen.shape[1]):
        seen = detections.seen[:, hand]
        if not seen.any():
            continue
        times, values = picture_times[seen].contiguous(), detections.contact_prob[seen, hand]
        after = torch.searchsorted(times, timestamps).clamp(max=len(times) - 1)
        before = (after - 1).clamp(min=0)
        nearest = torch.where((times[after] - timestamps).abs() < (times[before] - timestamps).abs(), after, before)
        near = (times[nearest] - timestamps).abs() <= hold_s + 1e-9
        prob[:, hand] = torch.where(near, values[nearest], 0.0)
    return prob
