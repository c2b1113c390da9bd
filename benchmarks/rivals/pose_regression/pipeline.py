"""AvatarPoser-style capture (Jiang et al. 2022): each pose from the past frames, anchored to the measured head."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from benchmarks.rivals.pose_regression.features import TrackedPoints, pasts
from benchmarks.rivals.pose_regression.net import PoseRegressor
from wearcap.body.skeleton import Skeleton
from wearcap.errors import WearcapError
from wearcap.recording import Motion, Recording
from wearcap.recording.timing import at_times
from wearcap.runtime.system import CaptureInput, LearnedSystem
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.tracking.anchor import anchored_to_head, with_hand_moved
from wearcap.tracking.head_path import head_path


@dataclass
class PoseRegressorCapture(LearnedSystem):
    """Captures whole recordings frame by frame, deterministically and without lookahead."""

    net: PoseRegressor
    points: TrackedPoints
    skeleton: Skeleton
    """Skeleton for recordings without one of their own."""
    fps: float
    reach: bool = True
    """Whether arms are adjusted by inverse kinematics to reach tracked wrists, AvatarPoser's last step."""
    frames_per_pass: int = 4096
    device: str = "cpu"

    name = "pose_regressor"
    pipeline = "pose_regressor"
    experiment = "experiment=pose_regressor_head or pose_regressor_hands"
    shared = ("pose_regressor_hands",)

    @torch.inference_mode()
    def motions(self, sources: Sequence[CaptureInput], seeds: Sequence[int]) -> list[Motion]:
        """One motion per recording; seeds have no effect.

        Raises WearcapError for a recording without head poses, or without true motion when hands are tracked.
        """
        self.net.to(self.device).eval()
        return [self._captured(source.recording) for source in sources]

    def _captured(self, recording: Recording) -> Motion:
        path = head_path(recording, self.skeleton, self.fps)
        names, truth = self.points.points, recording.motion
        if len(names) == 1:
            tracked = self.points.poses(path.skeleton, path.T_world_head)
        elif truth is None:
            expected = "a recording with `motion`, or a checkpoint of the head alone"
            raise WearcapError("no tracked hands in this recording", where=recording.name, expected=expected)
        else:  # poses of the hands come from the true motion
            if len(truth) != len(path.timestamps) or (truth.timestamps - path.timestamps).abs().max() > 1e-6:
                truth = at_times(truth, path.timestamps)
            tracked = self.points.poses(path.skeleton, path.T_world_head, truth.R_parent_joint)
        stature = torch.tensor([path.stature])
        # After a gap or a jump of the tracking the past starts empty.
        count = len(path.timestamps)
        begins = [0, *(start for start, _ in path.stretches[1:]), count]
        predicted = []
        for a, b in pairwise(begins):
            features = self.points.encode(
                tracked.R[None, a:b], tracked.t[None, a:b], path.floor_height[None, a:b], stature, self.fps
            )
            for ends in torch.arange(b - a).split(self.frames_per_pass):
                past, exists = pasts(features, ends[None], self.net.window)
                predicted.append(self.net(past[0].to(self.device), exists[0].to(self.device)))
        poses = HeadFeatures(joints=len(path.skeleton))
        R_parent_joint, _ = poses.decode(torch.cat(predicted).float().cpu()[None], path.T_world_head.R[None])
        about = {"pipeline": "pose_regressor", "points": ",".join(names), "reach": str(self.reach)}
        motion = Motion(path.timestamps, path.skeleton, R_parent_joint[0], torch.zeros(count, 3), provenance=about)
        motion = anchored_to_head(motion, path.T_world_head)
        for index, name in enumerate(names if self.reach else ()):
            side, _, joint = name.partition("_")
            if joint == "wrist":
                motion = with_hand_moved(motion, side, tracked.t[:, index] - motion.joint(name).t)
        return motion
