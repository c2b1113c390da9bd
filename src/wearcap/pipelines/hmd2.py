"""HMD² (thesis ch. 6): full-body motion from a head-mounted device by conditional motion diffusion.

Here with the head path alone, the thesis' ablation row "without points, without images".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from wearcap.body.hang import hang
from wearcap.body.skeleton import Skeleton
from wearcap.data.features import HeadFeatures
from wearcap.data.floor import floor_beneath
from wearcap.data.prepare.check import MIN_DURATION_S
from wearcap.diffusion.sampler import sample
from wearcap.diffusion.schedule import Schedule
from wearcap.errors import WearcapError
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, resample
from wearcap.models.denoiser import MotionDenoiser
from wearcap.recording import Motion, Recording


@dataclass(frozen=True)
class HeadPath:
    """What the model is told about one recording, at the model's frame rate."""

    timestamps: Float64[Tensor, "time"]
    T_world_head: Rigid
    floor_height: Float[Tensor, "time"]
    skeleton: Skeleton

    @property
    def stature(self) -> float:
        """Height of the head joint in the rest pose (m)."""
        return self.skeleton.height_of("head")


@dataclass
class HMD2:
    """Captures whole recordings in overlapping windows (thesis eq. 6.5)."""

    net: MotionDenoiser
    features: HeadFeatures
    schedule: Schedule
    skeleton: Skeleton
    """For recordings that do not say whose body it is."""
    fps: float
    steps: int = 20
    stride: int | None = None
    """Frames by which windows advance; None: three quarters of a window (180 of the document's 240)."""
    eta: float = 1.0
    device: str = "cpu"

    @property
    def advance(self) -> int:
        """Frames by which windows advance. Raises WearcapError when the windows would not touch."""
        advance = 3 * self.net.window // 4 if self.stride is None else self.stride
        if not 0 < advance <= self.net.window:
            raise WearcapError(f"windows of {self.net.window} frames cannot advance by {advance}",
                               expected=f"a stride from 1 to {self.net.window}")  # fmt: skip
        return advance

    def __call__(self, recording: Recording, seed: int = 0) -> Motion:
        return self.capture([recording], [seed])[0]

    @torch.inference_mode()
    def capture(self, recordings: Sequence[Recording], seeds: Sequence[int]) -> list[Motion]:
        """One motion per (recording, seed); recordings share batches, which changes nothing but the time."""
        self.net.to(self.device).eval()
        paths = [head_path(recording, self.skeleton, self.fps) for recording in recordings]
        rotations = self._sample_windows(paths, seeds)
        return [hang_from_head(self._motion(path, R), path.T_world_head) for path, R in zip(paths, rotations)]

    def _sample_windows(self, paths: list[HeadPath], seeds: Sequence[int]) -> list[Tensor]:
        """R_parent_joint of every path: window after window, each holding on to what the last one said."""
        window, advance, joints = self.net.window, self.advance, self.features.joints
        lengths = [len(path.timestamps) for path in paths]
        done = [torch.zeros(length, joints, 3, 3) for length in lengths]
        random = [torch.Generator().manual_seed(seed) for seed in seeds]
        for start in range(0, max(lengths), advance):
            first = start == 0
            lanes = [i for i, n in enumerate(lengths) if first or start + window - advance < n]
            if not lanes:
                break
            batch = [_cut(paths[i], start, window) for i in lanes]
            overlap = 0 if first else window - advance
            held = [done[i][start : start + overlap] for i in lanes]
            noise = torch.stack(
                [
                    torch.randn(self.steps, window, self.features.motion_size, generator=random[i])
                    for i in lanes
                ],
                1,
            )
            predicted = self._sample_batch(batch, held, noise)
            for lane, i in enumerate(lanes):
                new = slice(start + overlap, min(start + window, lengths[i]))
                done[i][new] = predicted[lane, overlap : overlap + new.stop - new.start]
        return done

    def _sample_batch(
        self, batch: list[tuple[HeadPath, Bool[Tensor, "time"]]], held: list[Tensor], noise: Tensor
    ) -> Tensor:
        R_head = torch.stack([path.T_world_head.R for path, _ in batch])
        t_head = torch.stack([path.T_world_head.t for path, _ in batch])
        floor = torch.stack([path.floor_height for path, _ in batch])
        stature = torch.tensor([path.stature for path, _ in batch])
        valid = torch.stack([valid for _, valid in batch]).to(self.device)
        condition = self.features.condition(R_head, t_head, floor, stature, self.fps).to(self.device)
        overlap = held[0].shape[0]
        known = torch.zeros(noise.shape[1:])
        if overlap:
            # Re-expressed in this window's frame, which may have moved since the last one.
            R_known = torch.stack(held)
            encoded = self.features.encode(_padded(R_known, noise.shape[2]), R_head)
            known = self.net.motion_normalizer(encoded.to(self.device)).cpu()
        is_known = (torch.arange(noise.shape[2]) < overlap).expand(len(batch), -1)
        x0 = sample(
            lambda x_t, level: self.net(x_t, level, condition, valid),
            noise.to(self.device), self.schedule, eta=self.eta,
            known=known.to(self.device), is_known=is_known.to(self.device),
        )  # fmt: skip
        return self.features.decode(self.net.motion_normalizer.inverse(x0).float().cpu(), R_head)

    def _motion(self, path: HeadPath, R_parent_joint: Tensor) -> Motion:
        settings = {
            "pipeline": "hmd2",
            "steps": str(self.steps),
            "stride": str(self.advance),
            "eta": str(self.eta),
        }
        return Motion(
            path.timestamps, path.skeleton, R_parent_joint, torch.zeros(len(path.timestamps), 3),
            provenance=settings,
        )  # fmt: skip


def head_path(recording: Recording, fallback: Skeleton, fps: float) -> HeadPath:
    """Step 1: the head joint's path at `fps`, and the floor beneath it.

    Raises WearcapError when the recording has no head stream, or hardly one.
    """
    if recording.head is None:
        raise WearcapError("no head poses in this recording", where=recording.name,
                           expected="a recording with a `head` stream")  # fmt: skip
    head = recording.head
    if head.timestamps[-1] - head.timestamps[0] < MIN_DURATION_S:
        raise WearcapError(f"head poses of {len(head.timestamps)} frames", where=recording.name,
                           expected=f"at least {MIN_DURATION_S} s")  # fmt: skip
    skeleton = recording.skeleton or (recording.motion.skeleton if recording.motion else fallback)
    T_world_head = head.T_world_head
    trajectory = Trajectory(head.timestamps, T_world_head.R, T_world_head.t)
    count = int((head.timestamps[-1] - head.timestamps[0]).item() * fps + 1e-3) + 1
    timestamps = head.timestamps[0] + torch.arange(count, dtype=torch.float64) / fps
    if count != len(head.timestamps) or (timestamps - head.timestamps).abs().max() > 1e-4:
        trajectory = resample(trajectory, timestamps.clamp_max(head.timestamps[-1].item()))
    floor = floor_beneath(recording, timestamps, trajectory.t_world_body, skeleton.height_of("head"))
    return HeadPath(timestamps, trajectory.T_world_body, floor, skeleton)


def hang_from_head(motion: Motion, T_world_head: Rigid) -> Motion:
    """Last step: shift the body and turn its head so that the head is where it was measured."""
    R_parent_joint, T_world_joint = hang(motion.skeleton, motion.R_parent_joint, T_world_head)
    return replace(motion, R_parent_joint=R_parent_joint, t_world_root=T_world_joint.t[:, 0])


def _cut(path: HeadPath, start: int, length: int) -> tuple[HeadPath, Bool[Tensor, "time"]]:
    """Frames from `start`, the last one repeated behind the end, and which of them are real."""
    count = len(path.timestamps)
    take = torch.arange(start, start + length)
    valid = take < count
    take = take.clamp_max(count - 1)
    return HeadPath(
        path.timestamps[take], path.T_world_head[take], path.floor_height[take], path.skeleton
    ), valid


def _padded(R: Float[Tensor, "batch time joint 3 3"], length: int) -> Float[Tensor, "batch length joint 3 3"]:
    """Repeat the last frame up to `length`."""
    return R[:, torch.arange(length).clamp_max(R.shape[1] - 1)]
