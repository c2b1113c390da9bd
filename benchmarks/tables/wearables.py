"""A head tracker and two watches as people wear them: presets of their errors, and what they sense of a true motion.

"typical": a headset with visual-inertial SLAM such as Aria or Quest (millimetres of jitter, drift below 0.5 % of the path,
gravity known), and calibrated smartwatches (attitude 1 to 2°, some degrees of heading in ten minutes, a strap that is 3°
off and gives as much, clocks that agree to half a frame at 30 Hz by arm swings); wrists by controllers that are held, or
trackers that are strapped, 1 cm and 3° off (our assumption: we know of no published figure). "poor": heads as MocapEvery's paper
measured them with monocular SLAM (Table 5: 2.1 and 2.7°, 4.7 and 5.1 cm off), whose scale and vertical are calibration's,
and watches on loose straps. Bodies are guessed from a stature, as suits do it.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import Trajectory, nearest_frames
from wearcap.recording.motion import Motion
from wearcap.recording.recording import HeadStream, Recording
from wearcap.sensors.imu import ImuNoise, synthesize_imu
from wearcap.sensors.simulated import SlamNoise, slam_poses
from wearsim.sensors.suit import SUITS, BodyErrors, estimated_skeleton


@dataclass(frozen=True)
class WearableNoise:
    """Errors of a head tracker, of two watches, and of what is known of their wearer."""

    head: SlamNoise
    seat_m: float
    """Root mean square distance of the device from where it is believed to sit on the head, constant in a recording."""
    seat_deg: float
    """Root mean square angle between the device's axes and the head's, likewise."""
    watches: ImuNoise
    body: BodyErrors
    wrists: SlamNoise
    """Errors of wrists that are tracked by the head's device, beside those of its own path, which they share."""
    grip_m: float
    """Root mean square distance of a tracked wrist from where it is believed to be, constant in a recording: a controller or
    a strap sits differently every time."""
    grip_deg: float
    """Root mean square angle of a tracked wrist's axes, likewise."""

    @classmethod
    def preset(cls, name: str) -> "WearableNoise":
        """Errors of devices "ideal", "typical" or "poor". Raises WearcapError for another name."""
        if name not in WEARABLES:
            raise WearcapError(f"wearables={name!r}", expected=f"one of {', '.join(WEARABLES)}")
        return WEARABLES[name]


WEARABLES = {
    "ideal": WearableNoise(
        SlamNoise(jitter_m=0.0, jitter_deg=0.0),
        seat_m=0.0,
        seat_deg=0.0,
        watches=ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        body=SUITS["ideal"].body,
        wrists=SlamNoise(jitter_m=0.0, jitter_deg=0.0),
        grip_m=0.0,
        grip_deg=0.0,
    ),
    "typical": WearableNoise(
        SlamNoise(
            drift_share=0.01,  # 3 cm after 10 m, 10 cm after 100 m
            yaw_drift_deg_per_sqrt_min=0.1,
            wander_m=0.01,
            wander_deg=0.3,
            wander_period_s=10.0,
            lean_deg=0.3,
            scale=0.002,
        ),
        seat_m=0.01,
        seat_deg=2.0,
        watches=ImuNoise(clock_offset_s=0.017, clock_ppm=50.0, play_deg=3.0, heading_deg=2.0),
        body=SUITS["typical"].body,
        wrists=SlamNoise(jitter_m=0.002, jitter_deg=0.3),
        grip_m=0.01,
        grip_deg=3.0,
    ),
    "poor": WearableNoise(
        SlamNoise(
            jitter_m=0.003,
            jitter_deg=0.2,
            drift_share=0.02,
            yaw_drift_deg_per_sqrt_min=0.5,
            wander_m=0.05,
            wander_deg=2.4,
            lean_deg=1.0,
            scale=0.02,
        ),
        seat_m=0.02,
        seat_deg=4.0,
        watches=ImuNoise(2.5, 2.5, 0.08, 0.05, 0.6, 6.0, 0.05, 100.0, play_deg=6.0, heading_deg=5.0),
        body=SUITS["poor"].body,
        wrists=SlamNoise(jitter_m=0.004, jitter_deg=0.6, wander_m=0.01, wander_deg=2.0),
        grip_m=0.025,
        grip_deg=6.0,
    ),
}
"""Head trackers and watches by name; those of "ideal" have no error at all, as in the papers' synthetic data."""


def with_noise(recording: Recording, noise: WearableNoise, rng: np.random.Generator) -> Recording:
    """What devices sense of a recording's true motion, and what their wearer knows: nothing of the truth is left in it.

    The head's path, watches, tracked wrists and points are in one SLAM world: points and wrists lie where they were seen
    from the path as tracked.
    The body is guessed from a measured stature; there is no floor. Raises WearcapError without a head or a true motion.
    """
    motion, head = recording.motion, recording.head
    if motion is None or head is None:
        raise WearcapError("nothing to sense", where=recording.name, expected="a head device and a true motion")
    turned, shifted = torch.from_numpy(rng.standard_normal((2, 3)) / np.sqrt(3)).float()
    R_head_device = head.R_head_device @ rotation.exp(np.deg2rad(noise.seat_deg) * turned)
    seat = Rigid(R_head_device, head.t_head_device + noise.seat_m * shifted)
    T_true = motion.joint("head") @ seat
    T_sensed, scale = slam_poses(T_true, motion.fps, noise.head, rng)
    points = recording.points
    if points is not None:
        seen = motion.timestamps[:1] if points.first_seen is None else points.first_seen
        frame = nearest_frames(motion.timestamps, seen)
        from_device: Tensor = T_true[frame].inverse() @ points.points_world  # pyright: ignore[reportAssignmentType]
        points = replace(points, points_world=T_sensed[frame] @ (scale * from_device))
    imu = {joint: synthesize_imu(motion, joint, noise=noise.watches, rng=rng) for joint in WRISTS}
    skeleton = estimated_skeleton(motion.skeleton, noise.body, rng)
    return Recording(
        recording.name,
        head=HeadStream(motion.timestamps, T_sensed.R, T_sensed.t, head.R_head_device, head.t_head_device),
        imu=imu,
        tracked={joint: _tracked(motion, joint, T_sensed @ T_true.inverse(), noise, rng) for joint in WRISTS},
        camera=recording.camera,
        points=points,
        skeleton=skeleton,
        subject=recording.subject,
        location=recording.location,
        activity=recording.activity,
        source=recording.source,
        license=recording.license,
    )


def _tracked(motion: Motion, joint: str, drift: Rigid, noise: WearableNoise, rng: np.random.Generator) -> Trajectory:
    """A wrist as the head's device tracks it: `drift` (time) leads from the true world to that of its SLAM."""
    turned, shifted = torch.from_numpy(rng.standard_normal((2, 3)) / np.sqrt(3)).float()
    grip = Rigid(rotation.exp(np.deg2rad(noise.grip_deg) * turned), noise.grip_m * shifted)
    T_sensed, _ = slam_poses(drift @ motion.joint(joint) @ grip, motion.fps, noise.wrists, rng)
    return Trajectory(motion.timestamps, T_sensed.R, T_sensed.t)
