"""The truth of a data set by person: figures of a sample of each person's motion, against what people's bodies do."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import numpy as np

from wearcap.checks.report import Check, Finding
from wearcap.metrics.truth import truth
from wearcap.recording import Recording, RecordingStore
from wearcap.recording.store import RecordingFile

SAMPLE_S, CUT_S = 180.0, 10.0
"""Motion (s) that is looked at of each person, and least length of a cut of a recording that is longer."""
_NEEDED = ("pelvis", "head", *(f"{side}_{name}" for side in ("left", "right") for name in ("hip", "knee", "ankle")))
_LEGS = "Check the source's skeleton: legs too long for their hips crouch."
_FLOOR = "Check the floor's height, and where the skeleton's soles lie."


@dataclass(frozen=True)
class Figure:
    """One of the figures of `truth`: its heading, its digits, the bounds of what people do, and what is wrong beyond them."""

    name: str
    heading: str
    digits: int = 0
    low: float = -inf
    high: float = inf
    what: str = ""
    fix: str = ""

    def text(self, figures: dict[str, float]) -> str:
        """Its value among a person's figures, a dash for one that is not known."""
        return f"{figures[self.name]:.{self.digits}f}" if self.name in figures else "–"

    def is_odd(self, figures: dict[str, float]) -> bool:
        """Whether its value lies outside the bounds."""
        return self.name in figures and not self.low <= figures[self.name] <= self.high


FIGURES = (
    Figure("minutes", "min", 1),
    Figure("cycles", "cycles"),
    Figure("knee_rms_deg", "knee off normal °", 1, 0, 9, "walks with knees unlike people's", _LEGS),
    Figure("stance_deg", "stance knee °", 1, 2, 20, "walks on bent knees", _LEGS),
    Figure("standing_deg", "standing knee °", 1, 0, 15, "stands on bent knees", _LEGS),
    Figure("curves_deg", "left − right °", 1, 0, 10, "left and right knees walk differently", _LEGS),
    Figure("bones_cm", "left − right cm", 1, 0, 2, "bones differ left from right", "Check the bones' lengths."),
    Figure("sole_cm", "sole cm", 1, -1.5, 1.5, "planted soles are not on the floor", _FLOOR),
    Figure("sole_low_cm", "5 % cm", 1, -4, 5, "planted soles are through the floor", _FLOOR),
    Figure("sole_high_cm", "95 % cm", 1, -4, 5, "planted soles are over the floor", _FLOOR),
    Figure("skate_cm_s", "skate cm/s", 1, 0, 20, "planted feet skate", "Check the frame rate and the contacts."),
    Figure("jumps_per_min", "jumps /min", 1, 0, 0, "joints jump", "Cut or mend those frames."),
    Figure("stature_m", "stature m", 2, 1.4, 2.1, "unusual stature", "Check the unit of length."),
    Figure("leg", "leg", 3, 0.46, 0.52, "legs are unlike people's, for that stature", _LEGS),
    Figure("eyes", "eyes", 3, 0.915, 0.955, "the head's device is not at the eyes", "Check the head's joint."),
    Figure("pitch_deg", "pitch °", 0, -5, 25, "the head is tilted while walking", "Check the head's axes."),
    Figure("pitch_spread_deg", "± °"),
)
"""What is reported of each person, in the order of the columns. Bounds: Perry & Burnfield; Drillis & Contini; Winter."""


def people(store: RecordingStore, names: Iterable[str]) -> dict[str, dict[str, float]]:
    """Figures of each person of these recordings of a data set from `SAMPLE_S` of motion; people without are left out."""
    own: dict[str, list[str]] = {}
    for name in names:
        own.setdefault(store.entries[name].context.subject or "unnamed", []).append(name)
    sampled = {subject: _sample(store, own[subject]) for subject in sorted(own)}
    return {subject: truth(cuts) for subject, cuts in sampled.items() if cuts}


def of_person(figures: dict[str, float]) -> list[Finding]:
    """A warning for each figure of a person that is out of bounds."""
    check, odd = Check("truth"), [figure for figure in FIGURES if figure.is_odd(figures)]
    return [check.warning(f.what, f"{f.heading}: {f.text(figures)}, people's {f.low:g}…{f.high:g}", f.fix) for f in odd]


def _sample(store: RecordingStore, names: list[str]) -> list[Recording]:
    """At most `SAMPLE_S` of these recordings' motion, spread evenly over them, from the middle of each."""
    total = sum(store.entries[name].duration_s for name in names)
    if total > SAMPLE_S:
        count = min(len(names), round(SAMPLE_S / min(total / len(names), CUT_S)))
        names = [names[k] for k in np.linspace(0, len(names) - 1, count).round().astype(int)]
    seconds = SAMPLE_S / len(names) if total > SAMPLE_S else SAMPLE_S
    cuts = [_cut(store.path_of(name), seconds) for name in names]
    return [cut for cut in cuts if cut is not None]


def _cut(path: Path, seconds: float) -> Recording | None:
    """A recording with the middle of its motion; None without motion or legs. Only that part of the file is read."""
    recording = RecordingFile(path, verify=False).load()
    motion = recording.motion
    if motion is None or len(motion) < 4 or any(joint not in motion.skeleton for joint in _NEEDED):
        return None
    spare = max((motion.timestamps[-1] - motion.timestamps[0]).item() - seconds, 0.0) / 2
    return replace(recording, motion=motion.between(spare, spare + seconds))
