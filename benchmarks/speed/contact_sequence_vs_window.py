"""Contact of 60 s at 60 Hz: ours in one pass, against the published form of one window per frame in batches of 100.

Poses to probabilities, features included; both classes by ours, one class by the published network, which needs two
for both. Their turns alternate. value and baseline: median seconds. ratio = baseline / value, to be at least `goal`.
Weights do not change the speed: they are drawn at random.
"""

import torch

from benchmarks.speed import planted
from benchmarks.speed.figures import figure, in_turns
from wearcap.systems.ireplica.contact_prediction import ContactDetector, ContactPredictor
from wearcap.systems.ireplica.contact_sequence import ContactSequence
from wearcap.systems.ireplica.contact_transformer import ContactTransformer
from wearcap.systems.ireplica.features import HandViews, SmplAngles

SECONDS = 60.0


def predictors() -> tuple[ContactPredictor, ContactPredictor]:
    """Ours for both classes, the published one for sliding objects."""
    torch.manual_seed(0)
    views, angles = HandViews(), SmplAngles()
    return (
        ContactPredictor(ContactDetector(ContactSequence(views.size), views, ("sliding", "hinged"))),
        ContactPredictor(ContactDetector(ContactTransformer(angles.size), angles, ("sliding",))),
    )


def measure(seconds: float = SECONDS, rounds: int = 5) -> list[dict]:
    motion = planted.swinging("swing", seconds, 0).motion
    assert motion is not None
    value, baseline = in_turns([lambda each=each: each(motion) for each in predictors()], rounds)
    return [figure("contact_sequence_vs_window", value, "s", baseline, baseline / value, 20.0)]
