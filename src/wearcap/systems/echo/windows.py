"""ECHO's overlapping windows in place of the conveyor, each denoised from scratch: with inpainted overlap (ECHO Fig. 3,
left), or averaged (ours)."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from wearcap.body.skeleton import MIRROR, Skeleton
from wearcap.data.transforms import joint_twins
from wearcap.diffusion.process import posterior_step, step_levels
from wearcap.geometry.rotation import matrix_from_rot6d, rot6d_from_matrix
from wearcap.runtime.windows import moved_on
from wearcap.systems.echo.features import CONTACTS
from wearcap.systems.echo.model import MODALITIES
from wearcap.systems.echo.queue import Conditioning, EchoQueue, Guided, Outputs


class Rewindow(EchoQueue):
    """Windows that advance by `stride` frames: the last final frames (at most the context) are inpainted, the next
    `stride` frames become final, and the rest is discarded.

    With the conveyor's context, a frame sees as much of the past and future as on the conveyor. As many network evaluations
    of a window as the conveyor's are `per_frame` times `stride` steps.
    """

    def __init__(self, pipeline: Any, skeletons: Sequence[Skeleton], seeds: Sequence[int]):
        super().__init__(pipeline, skeletons, seeds)
        self.stride, self.steps = pipeline.stride, pipeline.sampling.rewindow_steps or self.rolling.steps

    @torch.no_grad()
    def window(
        self, conditioning: Conditioning, before: Float[Tensor, "batch observed feature"]
    ) -> Float[Tensor, "batch frame feature"]:
        """A sampled window in normalised space, whose first frames are inpainted with `before`."""
        frame = self.pipeline.model.features.canonical(conditioning.points)
        count, observed_frames = conditioning.valid.shape[1], before.shape[1]
        observation = self._observation(conditioning, frame)
        denoise, corrections = self.pipeline.denoiser(self, conditioning, frame)
        correct = self._corrected(corrections, conditioning, observation)
        levels = step_levels(self.steps, self.rolling.spacing)
        # Always a full window's noise: a batch item's noise must not depend on the length of the others.
        x = self._noise(self.rolling.window)[:, :count]
        observed = observation.observed.clone()
        observed[:, :observed_frames] = before
        is_observed = observation.is_observed.clone()
        is_observed[:, :observed_frames] = ~observation.is_absent[:, :observed_frames]
        wide = self.conveyor.wide
        for now, after in pairwise(levels):
            level, then = (
                torch.where(is_observed, 0.0, torch.where(observation.is_absent, 1.0, value)) for value in (now, after)
            )
            x = torch.where(wide(is_observed), observed, x)
            x0_hat = correct(denoise(x, level))
            noise = self._noise(self.rolling.window)[:, :count]
            x = posterior_step(
                x, x0_hat, wide(level), wide(then), noise, self.pipeline.model.schedule, self.rolling.eta
            )
        return x

    @torch.no_grad()
    def run(self, whole: Conditioning) -> Outputs:
        """Outputs of all frames of a batch."""
        context, count = self.rolling.context, whole.valid.shape[1]
        outputs: list[Outputs] = []
        before, start = torch.zeros(len(whole.valid), 0, sum(self.pipeline.model.net.sizes)), 0
        while start < count:
            first = max(0, start - context)
            conditioning = whole.frames(slice(first, min(first + self.rolling.window, count)))
            before = before[:, before.shape[1] - (start - first) :]
            frame = self.pipeline.model.features.canonical(conditioning.points)
            if self._frame is not None and self.pipeline.model.features.moves:
                change, observed = frame.inverse() @ self._frame, conditioning.frames(slice(0, start - first))
                before = self._reexpressed(before, change, torch.zeros(1, 1, len(MODALITIES)), observed)
            self._frame = frame
            x = self.window(conditioning, before)
            stop = min(start + self.stride, count)
            outputs.append(self._decoded(x, slice(start - first, stop - first), frame))
            final = x[:, : stop - first]
            before, start = final[:, -context:] if context else final[:, :0], stop
        return Outputs(*(torch.cat(parts, 1) for parts in zip(*outputs)))


class AveragedWindows(Rewindow):
    """Windows that advance by `stride` frames without knowing of each other; what they predict for a frame is averaged.

    In one step from noise (`steps` 1) each is the mean of the plausible motions. Predictions weigh by the square of the
    frame's distance from the window's ends, unless the capture begins or ends there. Frames become final at the same
    latency as on the conveyor, `stride` at a time. With `mirror_average` what is predicted for the mirrored
    window counts as much.
    """

    def __init__(self, pipeline: Any, skeletons: Sequence[Skeleton], seeds: Sequence[int]):
        super().__init__(pipeline, skeletons, seeds)
        self._mirror = pipeline.sampling.mirror_average
        if self._mirror:  # the batch items' mirrored twins follow them
            twins = joint_twins(pipeline.model.skeleton)
            mirrored = self.t_parent_joint[..., twins, :] * torch.tensor(MIRROR)
            self.t_parent_joint, self.size = torch.cat([self.t_parent_joint, mirrored]), self.size.repeat(2, 1)
            self._random += [torch.Generator().manual_seed(seed) for seed in seeds]
        joints = self.t_parent_joint.shape[-2]
        self._sum = torch.zeros(len(seeds), 0, 6 * (joints + 1) + 3 + 3 + CONTACTS + 1)
        """Weighted sums of the predictions for the last window's frames (`_flat`), and sums of weights."""
        self._given = torch.zeros(len(seeds), 0, _GIVEN)
        """What these predictions were for (`_given`)."""

    def guide(self, guided: Guided) -> None:
        if self._mirror:
            surfaces, objects = guided
            flip = np.array(MIRROR)
            mirrored = [[KDTree(tree.data * flip) for tree in mine] for mine in objects]
            guided = [*surfaces, *surfaces], [*objects, *mirrored]
        super().guide(guided)

    @property
    def _due(self) -> int:
        return self.stride - self.taken % self.stride

    def _advance(self) -> Outputs | None:
        """Predict a window where `stride` frames have come since the last one; returns the frames that became final.

        A frame with another object, observation or pose of a tracked point than in the last window starts anew. What later
        windows predict for final frames is not used.
        """
        conditioning, joints = self.frames, self.t_parent_joint.shape[-2]
        assert conditioning is not None
        if self.taken % self.stride:
            return None
        before, given_before = (moved_on(part, self.stride, self.count) for part in (self._sum, self._given))
        self._given = _given(conditioning)
        same = ((self._given - given_before).abs() < _ALIKE).all(-1, keepdim=True)
        flat = self._predicted(conditioning)
        flat = torch.cat([flat, torch.ones_like(flat[..., :1])], -1)
        self._sum = before * same + flat * self._weight(conditioning.valid)[..., None]
        rows = self._sum[:, self.finalize(self.rolling.ramp - self.stride)]
        return _unflat(rows[..., :-1] / rows[..., -1:], joints) if rows.shape[1] else None

    def _predicted(self, conditioning: Conditioning) -> Float[Tensor, "batch frame value"]:
        """What a window is predicted to be on its own, flat."""
        model, count = self.pipeline.model, len(conditioning.valid)
        if self._mirror:
            both = zip(conditioning, conditioning.mirrored(model.skeleton))
            conditioning = Conditioning(*(torch.cat(fields) for fields in both))
        x = self.window(conditioning, torch.zeros(len(conditioning.valid), 0, sum(model.net.sizes)))
        outputs = self._decoded(x, slice(None), model.features.canonical(conditioning.points))
        flat = _flat(Outputs(*(field[:count] for field in outputs)))
        if not self._mirror:
            return flat
        return (flat + _flat(Outputs(*(field[count:] for field in outputs)).mirrored(model.skeleton))) / 2

    def _weight(self, valid: Bool[Tensor, "batch frame"]) -> Float[Tensor, "batch frame"]:
        count, window = valid.shape[1], self.rolling.window
        place = torch.arange(1, count + 1).expand_as(valid)
        begins, ended = self.taken <= window, ~valid[:, -1:]
        behind = torch.full_like(place, window) if begins else place
        ahead = torch.where(ended, window, count + 1 - place)
        return torch.minimum(behind, ahead).clamp_max(window // 2).square().float()

    def run(self, whole: Conditioning) -> Outputs:
        return EchoQueue.run(self, whole)


_GIVEN, _ALIKE = 1 + len(MODALITIES) + 3 * 13 + 12, 1e-4
"""Values of `_given`, and the difference up to which they are the same."""


def _given(conditioning: Conditioning) -> Float[Tensor, "batch frame value"]:
    """What a stream may change in a frame that windows have predicted: the active object, what is observed, tracked points
    whose poses are corrected after a loss, and the observed pose of the object."""
    observed = conditioning.is_observed
    points = conditioning.R_world_point.flatten(2), conditioning.t_world_point.flatten(2), conditioning.seen.float()
    pose = torch.cat([conditioning.R_world_object.flatten(2), conditioning.t_world_object], -1)
    pose = torch.where(observed[..., 1:2], pose, 0.0)
    return torch.cat([conditioning.object_number[..., None], observed.float(), *points, pose], -1)


def _flat(outputs: Outputs) -> Float[Tensor, "batch frame value"]:
    """Outputs as values that may be averaged, rotations in 6D."""
    R = torch.cat([outputs.R_parent_joint, outputs.R_world_object[:, :, None]], 2)
    return torch.cat(
        [rot6d_from_matrix(R).flatten(-2), outputs.t_world_root, outputs.t_world_object, outputs.contact_prob], -1
    )


def _unflat(values: Float[Tensor, "batch frame value"], joints: int) -> Outputs:
    """The inverse of `_flat`."""
    rotations, root, scene_object, contact = values.split([6 * (joints + 1), 3, 3, CONTACTS], -1)
    R = matrix_from_rot6d(rotations.unflatten(-1, (-1, 6)))
    return Outputs(R[:, :, :-1], root, R[:, :, -1], scene_object, contact)
