"""Initial labels of an annotation, from a network or the recording, to be corrected by hand."""

from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.io.formats.contact_labels import LabelClock, Labels, labels_of, parse_labels
from wearcap.io.formats.motion_npz import read_motion
from wearcap.io.formats.text import read_json
from wearcap.recording.interactions import HANDS, Interactions
from wearcap.recording.motion import Motion
from wearcap.recording.recording import Recording
from wearcap.systems.ireplica.contact_intervals import ContactSettings, active, contact_intervals


def starting_labels(source: str | Path, recording: Recording, clock: LabelClock) -> Labels:
    """Labels of a label file (.json), of a captured motion (.npz), or for "recording" the recording's own.

    Raises WearcapError if the source has no contacts, or impossible ones.
    """
    if str(source) == "recording":
        if recording.interactions is None:
            raise WearcapError(
                "no interactions to start from",
                where=recording.name,
                expected="a recording that has them",
                fix="Start from a label file (.json), from a captured motion (.npz), or from nothing.",
            )
        return labels_of(recording.interactions, clock)
    if Path(source).suffix == ".json":
        return parse_labels(read_json(source), clock, where=source)
    motion = read_motion(source)
    found = motion.interactions or _predicted(motion)
    if found is None:
        raise WearcapError(
            "a motion without contacts of the hands",
            where=source,
            expected="one that a pipeline with a contact network captured",
        )
    return labels_of(found, clock)


def _predicted(motion: Motion) -> Interactions | None:
    """Contacts of each hand by itself, from probabilities with short gaps filled."""
    prob = motion.hand_contact_prob
    if prob is None:
        return None
    if prob.shape != (len(motion), len(HANDS)):
        raise WearcapError(f"hand contacts of shape {tuple(prob.shape)}", expected=f"({len(motion)}, {len(HANDS)})")
    contact = active(prob, motion.timestamps, ContactSettings())
    edges = _edges(motion.timestamps)
    spans, hands = [], []
    for hand in range(len(HANDS)):
        alone = contact & (torch.arange(len(HANDS)) == hand)
        for held in contact_intervals(alone):
            spans.append((edges[held.start].item(), edges[held.stop].item()))
            hands.append(held.hands)
    table = torch.tensor(spans, dtype=torch.float64).reshape(-1, 2)
    which = torch.tensor(hands, dtype=torch.bool).reshape(-1, len(HANDS))
    return Interactions(table[:, 0], table[:, 1], which, ("",) * len(spans), ("",) * len(spans))


def _edges(timestamps: Float64[Tensor, "time"]) -> Float64[Tensor, "edge"]:
    """Start times of frames, and the end of the last."""
    return torch.cat([timestamps, timestamps[-1:] + timestamps.diff().median()])
