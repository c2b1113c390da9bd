"""Key frames and the motion tracked between them, joined by least squares (ours).

Landmarks that are tracked from a key frame carry its pose's error on to the next one, where the pose by the old landmarks
and the pose by the new ones differ by both errors and by what tracking added. Errors of key frames are independent of one
another, and tracking adds little: the least-squares estimate of all errors averages over several key frames.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64

from wearcap.geometry import rotation
from wearcap.localization.absolute_pose import CameraPose

_PLAUSIBLE = 6.0
"""Squared disagreement of tracking and a key frame, over its expectation, beyond which neither tells about the other."""
_LEAST = 1e-10
"""Least variance (rad², m²) of a key frame's error."""


@dataclass(frozen=True, eq=False)
class ChainedPose:
    """Pose of a frame by the landmarks of a key frame."""

    pose: CameraPose
    key: CameraPose
    """Pose of that key frame."""
    drift: Float64[np.ndarray, "6 6"]
    """Covariance that tracking added to the key frame's."""
    before: "ChainedPose | None" = None
    """Pose of a key frame by the landmarks of the key frame before."""


@dataclass(eq=False)
class _Link:
    """Frames tracked from one key frame, and its error: ω (rad) with R = exp(ω) R_true, then position (m)."""

    start: int
    stop: int
    frames: list[ChainedPose]
    step: Float64[np.ndarray, "6"] | None
    """How far this key frame's pose is from the one by the landmarks before; None where there is none."""
    mean: Float64[np.ndarray, "6"]
    information: Float64[np.ndarray, "6 6"]
    drift: Float64[np.ndarray, "6 6"]
    """Covariance of what tracking added to `step`."""


def joined(poses: Sequence[ChainedPose | None]) -> list[CameraPose | None]:
    """Poses without the errors that key frames and tracking disagree by; None where there is none."""
    found: list[CameraPose | None] = [None] * len(poses)
    for chain in _chains(poses):
        _estimate(chain)
        for number, link in enumerate(chain):
            after = chain[number + 1] if number + 1 < len(chain) else None
            for index, frame in enumerate(link.frames):
                share = index / len(link.frames) if after is not None else 0.0
                if after is not None:
                    share *= min(1.0, np.trace(frame.drift[3:, 3:]) / max(np.trace(after.drift[3:, 3:]), 1e-12))
                error, covariance = (1 - share) * link.mean, (1 - share) * np.linalg.inv(link.information)
                if after is not None and after.step is not None:
                    error = error + share * (after.mean - after.step)
                    covariance = covariance + share * np.linalg.inv(after.information) + (1 - share) * frame.drift
                else:
                    covariance = covariance + frame.drift
                found[link.start + index] = _moved(frame.pose, -error, covariance)
    return found


def _chains(poses: Sequence[ChainedPose | None]) -> Iterator[list[_Link]]:
    """Stretches of frames in which each key frame's landmarks were tracked to the next key frame."""
    chain: list[_Link] = []
    for number, frame in enumerate(poses):
        last = chain[-1].frames[-1] if chain and chain[-1].stop == number else None
        if frame is None:
            continue
        if last is not None and frame.key is last.key:
            chain[-1].frames.append(frame)
            chain[-1].stop = number + 1
            continue
        own = _covariance(frame.key)
        link = _Link(number, number + 1, [frame], None, np.zeros(6), np.linalg.inv(own), np.zeros((6, 6)))
        if last is not None and frame.before is not None and frame.before.key is last.key:
            step, drift = _apart(frame.pose, frame.before.pose), frame.before.drift
            expected = own + _covariance(last.key) + drift
            if step @ np.linalg.solve(expected, step) < _PLAUSIBLE * len(step):
                link.step, link.drift = step, drift
        if chain and link.step is None:
            yield chain
            chain = []
        chain.append(link)
    if chain:
        yield chain


def _estimate(chain: list[_Link]) -> None:
    """Fill in means and information of the key frames' errors: messages along the chain, forwards and backwards.

    e₊ = e + step + drift, where each e is 0 with the key frame's covariance.
    """
    own = [link.information for link in chain]
    messages: list[list[tuple[np.ndarray, np.ndarray]]] = []
    for backwards in (False, True):
        mean, information, passed = np.zeros(6), np.zeros((6, 6)), []
        order = range(len(chain) - 1, -1, -1) if backwards else range(len(chain))
        for number in order:
            passed.append((information, mean))
            total = own[number] + information
            mean = np.linalg.solve(total, information @ mean)
            following = number if backwards else number + 1
            if 0 < following < len(chain):
                step = chain[following].step
                assert step is not None
                mean = mean - step if backwards else mean + step
                information = np.linalg.inv(np.linalg.inv(total) + chain[following].drift)
        messages.append(passed[::-1] if backwards else passed)
    for link, (left, left_mean), (right, right_mean) in zip(chain, *messages):
        link.information = link.information + left + right
        link.mean = np.linalg.solve(link.information, left @ left_mean + right @ right_mean)


def _covariance(pose: CameraPose) -> Float64[np.ndarray, "6 6"]:
    return pose.covariance.double().numpy() + _LEAST * np.eye(6)


def _apart(pose: CameraPose, other: CameraPose) -> Float64[np.ndarray, "6"]:
    """Turn (rad, world axes) and displacement (m) from another pose to a pose."""
    turn = rotation.log(pose.R_world_cam.double() @ other.R_world_cam.double().T)
    return torch.cat([turn, (pose.t_world_cam - other.t_world_cam).double()]).numpy()


def _moved(pose: CameraPose, step: Float64[np.ndarray, "6"], covariance: Float64[np.ndarray, "6 6"]) -> CameraPose:
    turn, move = torch.from_numpy(step).split(3)
    R = rotation.exp(turn) @ pose.R_world_cam.double()
    covariance_of = torch.from_numpy(covariance).float()
    return replace(
        pose, R_world_cam=R.float(), t_world_cam=(pose.t_world_cam.double() + move).float(), covariance=covariance_of
    )
