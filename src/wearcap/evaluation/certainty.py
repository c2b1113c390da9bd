"""How sure a checkpoint's network is of joints, fitted anew to what it captures of a validation split, without training."""

from collections.abc import Sequence
from pathlib import Path

import torch
from rich.progress import track
from torch import Tensor

from wearcap.errors import WearcapError
from wearcap.metrics.certainty import deviations, tails
from wearcap.metrics.scores import comparable
from wearcap.models.checkpoint import read_checkpoint
from wearcap.recording import RecordingStore
from wearcap.runtime.system import CaptureInput, System

_MEAN = "net.motion_normalizer.mean"
"""Statistics whose last values are the logarithms of factors of the joints' deviations."""


def refitted(system: System, checkpoint: str | Path, store: RecordingStore, names: Sequence[str]) -> dict[str, Tensor]:
    """Statistics by name that replace a checkpoint's, so that 68.3 % and 95 % of the errors of captured recordings are within
    the reach of these shares: one factor of all joints' deviations (single ones depend on few people), and the degrees of
    freedom.

    Raises WearcapError for a network that does not say how sure it is, and for recordings without a true motion, or none.
    """
    mean, away, joints = read_checkpoint(checkpoint)[1].get(_MEAN), [], 0
    for name in track(names, description="captured"):
        source = CaptureInput.in_dataset(store.load(name), store.root)
        motion, truth, _ = comparable(system(source), source.recording, name)
        found, joints = deviations(motion, truth), len(motion.skeleton)
        if found is None or mean is None:
            raise WearcapError("a network that does not say how sure it is", checkpoint, "features.spread=true")
        away.append(found[~found.isnan()])
    if not away or mean is None:
        raise WearcapError("no recordings to fit to", store.root, fix="Choose a data set with a validation split.")
    factor, dof = tails(torch.cat(away))
    mean[-joints:] += torch.tensor(factor).log()
    return {_MEAN: mean, "joint_dof": torch.tensor(dof or 0.0)}
