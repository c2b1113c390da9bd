"""Checks of a stream over time: its clock, valid rotations, metres, the up axis, quaternion order, heading along the path."""

import math

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from wearcap.checks.report import Check, Finding, has_error
from wearcap.geometry import rotation
from wearcap.geometry.correlation import best_shift, correlate_shifts
from wearcap.geometry.trajectory import Trajectory, interpolate, linear_velocity
from wearcap.sensors.imu import acceleration

LAG_RATE_HZ = 200.0


def quantile(value: Float[Tensor, "*any"], q: float) -> float:
    """Quantile of all entries (0 if empty); long signals are subsampled to a million entries."""
    flat = value.flatten().double()
    return torch.quantile(flat[:: len(flat) // 1_000_000 + 1], q).item() if len(flat) else 0.0


def spin_of(track: Trajectory) -> Float[Tensor, "time 3"]:
    """Angular velocity (rad/s) in the body's own axes, by central differences over two frames."""
    R, times = track.R_world_body.double(), track.timestamps
    if len(R) < 3:
        return torch.zeros(len(R), 3, dtype=torch.float64)
    turn = rotation.log(R[:-2].mT @ R[2:]) / (times[2:] - times[:-2])[:, None]
    return torch.cat([turn[:1], turn, turn[-1:]])


def acceleration_of(track: Trajectory) -> Float[Tensor, "time 3"]:
    """Acceleration (m/s²) in the world, as synthetic IMUs have it: MocapEvery eq. 8 over the span of 4 frames at 60 Hz."""
    if len(track) < 2:
        return torch.zeros(len(track), 3, dtype=torch.float64)
    fps = 1 / track.timestamps.diff().median().item()
    return acceleration(track.t_world_body.double(), fps, max(1, round(fps / 15)))


def lag_between(
    reference_times: Float64[Tensor, "time"],
    reference: Float[Tensor, "time"],
    other_times: Float64[Tensor, "sample"],
    other: Float[Tensor, "sample"],
    max_lag_s: float = 1.0,
) -> tuple[float, float, float] | None:
    """(lag in s, correlation at that lag, correlation without a shift) between two signals of the same quantity.

    A positive lag means that `other` is late. None if the streams share less than 4 s or a signal is constant.
    """
    start = max(reference_times[0].item(), other_times[0].item())
    stop = min(reference_times[-1].item(), other_times[-1].item())
    if stop - start < 4.0:
        return None
    grid = torch.arange(start, stop, 1 / LAG_RATE_HZ, dtype=torch.float64)[: int(600 * LAG_RATE_HZ)]
    a, b = (interpolate(reference_times, reference.double(), grid), interpolate(other_times, other.double(), grid))
    if a.std() < 1e-6 or b.std() < 1e-6:
        return None
    shifts, score = correlate_shifts(a.numpy(), b.numpy(), 0.7)
    near = abs(shifts) <= max_lag_s * LAG_RATE_HZ
    shifts, score = shifts[near], score[near]
    # Walking is periodic: among peaks as good as the highest, the smallest shift is taken.
    rising = np.diff(score, prepend=-np.inf) > 0
    falling = np.diff(score, append=-np.inf) <= 0
    peaks = (rising & falling & (score >= score.max() - 0.02)).nonzero()[0]
    peak = int(peaks[abs(shifts[peaks]).argmin()])
    beside = slice(max(peak - 1, 0), peak + 2)
    shift, best = best_shift(shifts[beside], score[beside])
    return shift / LAG_RATE_HZ, best, float(score[shifts == 0][0])


FASTEST_M_S = 12.0
"""Highest running speed (m/s); a faster frame is a jump, a faster recording is in the wrong unit."""
UPRIGHT = 0.7
"""Least mean z component of a head's or pelvis' own z axis in a recording of daily life."""
LOOKS_DOWN = 0.2
"""Least upright component of a head that looks down: by up to 78° on average."""
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2}
"""Units of devices; those of bodies follow from their bones."""


def check_clock(stream: str, timestamps: Float64[Tensor, "time"]) -> list[Finding]:
    """Rate, order, gaps and jitter of one stream's timestamps (s)."""
    check = Check(f"{stream}: clock")
    if len(timestamps) < 2:
        return [check.warning(f"{len(timestamps)} frames", "", "There is nothing to examine in time.")]
    if not timestamps.isfinite().all():
        evidence = f"{int((~timestamps.isfinite()).sum())} of them"
        return [check.error("timestamps are NaN", evidence, "Drop these frames.")]
    steps = timestamps.diff()
    if (steps <= 0).any():
        first = int((steps <= 0).nonzero()[0]) + 1
        evidence = f"{int((steps <= 0).sum())} times, first at frame {first} ({timestamps[first]:.4f} s)"
        return [check.error("timestamps do not rise", evidence, "Sort the frames by time and drop repeated ones.")]
    step = steps.median().item()
    evidence = f"{1 / step:.2f} Hz, {len(timestamps)} frames, {(timestamps[-1] - timestamps[0]).item():.1f} s"
    if 1 / step > 5000 or 1 / step < 2:
        fix = "Timestamps are in seconds: divide µs by 1e6, ns by 1e9."
        findings = [check.error(f"a rate of {1 / step:.4g} Hz", evidence, fix)]
    else:
        findings = [check.ok(f"{1 / step:.4g} Hz", evidence)]
    wide = steps > 1.5 * step
    if wide.any():
        missing = int((steps[wide] / step).round().sum().item() - int(wide.sum()))
        share = missing / (missing + len(timestamps))
        longest = int(steps.argmax())
        evidence = (
            f"{int(wide.sum())} gaps, about {missing} frames ({100 * share:.2g} %), the longest "
            f"{steps[longest]:.3f} s at {timestamps[longest] - timestamps[0]:.2f} s"
        )
        fix = "Cut the recording at long gaps, resample over short ones."
        findings.append(check.found("error" if share > 0.2 else "warning", "dropped frames", evidence, fix))
    jitter = ((steps[steps < 1.5 * step] - step).square().mean().sqrt() / step).item()
    if jitter > 0.1:
        evidence = f"they vary by {100 * jitter:.0f} % of a step"
        fix = "Use the sensor's own clock, not the time of arrival, or resample."
        findings.append(check.warning("uneven time steps", evidence, fix))
    return findings


def check_spans(spans: dict[str, Float64[Tensor, "_"]]) -> list[Finding]:
    """Whether all streams overlap in time."""
    ends = {name: (t[0].item(), t[-1].item()) for name, t in spans.items() if len(t) > 1 and bool(t.isfinite().all())}
    if len(ends) < 2:
        return []
    check = Check("streams' time spans")
    shared = min(stop for _, stop in ends.values()) - max(start for start, _ in ends.values())
    longest = max(stop - start for start, stop in ends.values())
    listed = ", ".join(f"{name} {start:.2f} … {stop:.2f} s" for name, (start, stop) in ends.items())
    if shared <= 0:
        fix = "Their clocks differ: bring all timestamps to one clock."
        return [check.error("streams do not overlap in time", listed, fix)]
    if shared < 0.8 * longest:
        return [check.note(f"streams share {100 * shared / longest:.0f} % of the longest", listed)]
    return [check.ok("streams overlap", listed)]


def check_track(stream: str, track: Trajectory) -> list[Finding]:
    """All checks of a path of poses: rotations, speed, up axis and, if all of these are sound, the forward axis."""
    findings = [*check_rotations(stream, track.R_world_body), *check_speed(stream, track)]
    if any("NaN" in f.what or "no rotations" in f.what for f in findings):
        return findings
    findings.append(_check_upright(stream, track))
    if has_error(findings):
        return findings
    # Whether the body's x axis points where it walks; only while it walks.
    check = Check(f"{stream}: forward axis")
    velocity = linear_velocity(track).double()[:, :2]
    walking = (velocity.norm(dim=-1) > 0.5) & (velocity.norm(dim=-1) < FASTEST_M_S)
    walked_s = walking.double().mean().item() * (track.timestamps[-1] - track.timestamps[0]).item()
    if walked_s < 3:
        return findings
    R = track.R_world_body.double()
    course = torch.atan2(velocity[:, 1], velocity[:, 0])[walking]
    offset, strength = _mean_angle(rotation.yaw_of(R)[walking] - course)
    evidence = f"x axis {math.degrees(offset):+.0f}° off the walking direction (agreement {strength:.2f}, {walked_s:.0f} s of walking)"
    if abs(offset) < math.radians(60) and strength > 0.5:
        return [*findings, check.ok("x is forward", evidence)]
    inverse_offset, inverse_strength = _mean_angle(rotation.yaw_of(R.mT)[walking] - course)
    if inverse_strength > max(0.8, strength) and abs(inverse_offset) < math.radians(45):
        evidence += f"; transposed they fit ({inverse_strength:.2f})"
        fix = "Store the pose of the body in the world (R_world_body), not its inverse."
        return [*findings, check.error("rotations are inverted", evidence, fix)]
    if strength < 0.5:
        fix = "The wearer may walk sideways or look around."
        return [*findings, check.note("facing and walking direction hardly agree", evidence, fix)]
    severity = "warning" if walked_s < 15 or abs(offset) < math.radians(75) else "error"
    fix = f"Turn the body's axes by {-math.degrees(offset):+.0f}° about z, if the wearer did walk ahead."
    return [*findings, check.found(severity, "x does not point forward", evidence, fix)]


def check_rotations(stream: str, R: Float[Tensor, "*batch 3 3"]) -> list[Finding]:
    """Rotations are finite, orthonormal and right-handed; the list is empty if so."""
    check = Check(f"{stream}: rotations")
    flat = R.reshape(-1, 3, 3).double()
    bad = ~flat.isfinite().all(-1).all(-1)
    if bad.any():
        evidence = f"{int(bad.sum())} of {len(flat)}"
        return [check.error("rotations are NaN", evidence, "Drop or fill these frames.")]
    error = (flat.mT @ flat - torch.eye(3, dtype=torch.float64)).abs().amax((-1, -2))
    if (error > 1e-2).any():
        evidence = f"{int((error > 1e-2).sum())} of {len(flat)}, off by up to {error.max():.2g}"
        fix = "Normalise quaternions before converting; check which columns hold them."
        return [check.error("matrices that are no rotations", evidence, fix)]
    if (torch.linalg.det(flat) < 0).any():
        fix = "Turn axes by rotations only; negate an axis in pairs."
        return [check.error("mirrored (left-handed) axes", "determinant -1", fix)]
    return []


def check_speed(stream: str, track: Trajectory) -> list[Finding]:
    """Positions are in metres, without jumps."""
    check = Check(f"{stream}: positions")
    if not track.t_world_body.isfinite().all():
        evidence = f"{int((~track.t_world_body.isfinite()).any(-1).sum())} frames"
        return [check.error("positions are NaN", evidence, "Drop or fill these frames.")]
    moved = track.t_world_body.double().diff(dim=0).norm(dim=-1)
    speed = moved / track.timestamps.diff()
    usual = quantile(speed, 0.9)
    path = moved.sum().item()
    evidence = f"90 % of frames below {usual:.3g} m/s, path {path:.4g} m"
    if usual > FASTEST_M_S:
        unit = min(_UNITS, key=lambda name: abs(math.log(usual * _UNITS[name] / 1.2)))
        fix = f"In {unit} it would be {usual * _UNITS[unit]:.2f} m/s: unit={_UNITS[unit]:.4g} says so."
        return [check.error("positions are not in metres", evidence, fix)]
    if len(speed) > 2 and track.timestamps[-1] - track.timestamps[0] > 10 and path < 0.01:
        return [check.warning("nothing moves", evidence, "Check the unit, and that this stream recorded at all.")]
    jumps = speed > FASTEST_M_S
    if jumps.any():
        worst = int(speed.argmax())
        evidence = (
            f"{int(jumps.sum())} steps faster than {FASTEST_M_S:g} m/s, the worst {moved[worst]:.2f} m at "
            f"{track.timestamps[worst + 1] - track.timestamps[0]:.2f} s"
        )
        fix = "Tracking was lost there: mask these frames (geometry.trajectory.outlier_mask)."
        return [check.warning("jumps", evidence, fix)]
    return [check.ok("in metres, without jumps", evidence)]


def _check_upright(stream: str, track: Trajectory) -> Finding:
    """Whether the body's own z axis points along the world's z, and if not, the likely mix-up."""
    check = Check(f"{stream}: up axis")
    R = track.R_world_body.double()
    up_world, up_body = R[:, :, 2].mean(0), R[:, 2, :].mean(0)
    listed = ", ".join(f"{v:+.2f}" for v in up_world.tolist())
    evidence = f"its z axis points along ({listed}) of the world, on average"
    if up_world[2] > UPRIGHT:
        return check.ok("z is up", evidence)
    if up_body[2] > LOOKS_DOWN and up_body[1].abs() < 0.25 and up_body[0] < 0:  # the left axis stays level
        down = math.degrees(math.atan2(-up_body[0].item(), up_body[2].item()))
        return check.note(f"looks down by {down:.0f}° on average", evidence, "If it did not, turn the device's axes.")
    spread = track.t_world_body.double().std(0)
    least, second = spread.argsort()[:2].tolist()
    # People move along the floor: the axis along which they clearly move least is vertical.
    vertical = least if spread[least] < 0.5 * spread[second] else None
    wxyz = rotation.quat_wxyz_from_matrix(R)
    orders = ((1, "xyzw (scalar last)"), (-1, "wxyz (scalar first)"))
    reread = {name: rotation.matrix_from_quat_wxyz(wxyz.roll(shift, -1)) for shift, name in orders}
    order = next((name for name, turned in reread.items() if turned[:, 2, 2].mean() > 0.85), None)
    consistent = up_world.norm() > 0.8
    if order and not (consistent and vertical in (0, 1)):
        evidence += f"; read as {order} it is upright"
        return check.error("quaternions are read in the wrong order", evidence, f"Read the quaternions as {order}.")
    if consistent and vertical != 2 and up_world.abs().max() > 0.7:
        name = axis_name(up_world)
        fix = f"Turn the world so that {name} becomes z (reader option up, or {name} → z for poses and points alike)."
        return check.error(f"the world's {name} axis is up, not z", evidence, fix)
    if up_body.norm() > 0.8 and up_body.abs().max() > 0.7:
        name = axis_name(up_body)
        fix = "Turn the device's own axes to x forward, y left, z up (R_world_device @ R_device_head axes)."
        return check.error(f"the body's {name} axis points up, not z", f"{evidence}; its {name} axis does", fix)
    fix = "Check axes and quaternion order; lying and crawling look like this too."
    return check.found("error" if up_world[2] < 0.3 else "warning", "is not upright", evidence, fix)


def _mean_angle(angle: Tensor) -> tuple[float, float]:
    """Circular mean (rad) and concentration (0 … 1) of angles."""
    cos, sin = angle.cos().mean().item(), angle.sin().mean().item()
    return math.atan2(sin, cos), math.hypot(cos, sin)


def axis_name(direction: Tensor) -> str:
    """The axis nearest to a direction, with its sign."""
    axis = int(direction.abs().argmax())
    return ("-" if direction[axis] < 0 else "+") + "xyz"[axis]
