"""A short walk of a head, and writers of foreign files by NumPy and SciPy alone: nothing here is wearcap's own."""

import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

CAMERA_IN_HEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""OpenCV's camera axes (x right, y down, z forward) in the head's (x forward, y left, z up)."""


def walk(seconds: float = 8.0, fps: float = 30.0, start: float = 1000.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (s), rotations and places (m) of a head that walks round a bend and nods: x ahead, y left, z up."""
    time = np.arange(int(seconds * fps)) / fps
    course = 0.35 * time + 0.2 * np.sin(0.7 * time)
    speed = np.stack([np.cos(course), np.sin(course)], 1) * 1.1 / fps
    place = np.concatenate([np.cumsum(speed, 0), 1.62 + 0.02 * np.sin(11 * time)[:, None]], 1)
    angles = np.stack([course + 0.2 * np.sin(2 * time), 0.1 + 0.1 * np.sin(1.7 * time), 0.05 * np.sin(2.3 * time)], 1)
    return start + time, Rotation.from_euler("ZYX", angles).as_matrix(), place


def quat_xyzw(R: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(R).as_quat()


def apart(found, time: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[float, float, float]:
    """Largest differences (s, m, degrees) of a read trajectory from the walk."""
    off = Rotation.from_matrix(np.swapaxes(found.R_world_body.double().numpy(), 1, 2) @ R).magnitude().max()
    return (
        np.abs(found.timestamps.numpy() - time).max(),
        np.linalg.norm(found.t_world_body.double().numpy() - t, axis=1).max(),
        np.degrees(off),
    )


def lines(path: Path, rows, head: str = "", between: str = " ") -> Path:
    path.write_text(head + "\n".join(between.join(row) for row in rows) + "\n")
    return path


def numbers(*parts) -> list[list[str]]:
    """Rows of the columns side by side, seven digits after the point; whole numbers stay whole."""
    columns = [np.asarray(part).reshape(len(part), -1) for part in parts]
    return [
        [
            str(value) if isinstance(value, int) else f"{value:.7f}"
            for column in columns
            for value in column[row].tolist()
        ]
        for row in range(len(columns[0]))
    ]


def tum(path: Path, time, R, t) -> Path:
    return lines(path, numbers(time, t, quat_xyzw(R)))


def euroc(path: Path, time, R, t) -> Path:
    head = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v [m s^-1]\n"
    )
    nano = np.round(time * 1e9).astype(np.int64)
    return lines(path, numbers(nano, t, quat_xyzw(R)[:, [3, 0, 1, 2]], 0 * time), head, ",")


def in_camera(R, t) -> tuple[np.ndarray, np.ndarray]:
    """Scalar-first quaternions and translations of the world in the body."""
    back = np.swapaxes(R, 1, 2)
    return quat_xyzw(back)[:, [3, 0, 1, 2]], -np.einsum("nij,nj->ni", back, t)


def colmap_text(path: Path, time, R, t) -> Path:
    """Pictures in any order, each followed by a line of its points, which may be empty."""
    quat, shift = in_camera(R, t)
    rows = []
    for k in np.random.default_rng(0).permutation(len(time)):
        rows += [[str(k + 1), *numbers(quat, shift)[k], "1", f"{time[k]:.6f}.png"], ["10.5 20.5 -1"] if k % 2 else [""]]
    return lines(
        path,
        rows,
        "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n",
    )


def colmap_binary(path: Path, time, R, t) -> Path:
    quat, shift = in_camera(R, t)
    content = struct.pack("<Q", len(time))
    for k, moment in enumerate(time):
        content += (
            struct.pack("<I7dI", k + 1, *quat[k], *shift[k], 1) + f"cam/{round(moment * 1e9)}.png".encode() + b"\0"
        )
        content += struct.pack("<Q2dq", 1, 1.5, 2.5, 7)
    path.write_bytes(content)
    return path


def hloc(path: Path, time, R, t) -> Path:
    quat, shift = in_camera(R, t)
    rows = [[f"query/{round(moment * 1e6)}.jpg", *row] for moment, row in zip(time, numbers(quat, shift))]
    return lines(path, rows)


def droid(path: Path, time, R, t) -> Path:
    """A reconstruction's folder: poses of the world in the camera, and times."""
    quat, shift = in_camera(R, t)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.concatenate([shift, quat[:, [1, 2, 3, 0]]], 1).astype(np.float32))
    np.save(path.with_name("tstamps.npy"), time)
    np.save(path.with_name("disps.npy"), np.ones((len(time), 2, 2), np.float32))
    return path


def droid_archive(path: Path, time, R, t) -> Path:
    np.savez(path, traj_est=np.concatenate([t, quat_xyzw(R)], 1), tstamps=time)
    return path


def kitti(path: Path, time, R, t) -> Path:
    lines(path.with_name("times.txt"), numbers(time))
    return lines(path, numbers(np.concatenate([R, t[:, :, None]], 2).reshape(len(R), 12)))


def mps(path: Path, time, R, t) -> Path:
    names = "graph_uid,tracking_timestamp_us,utc_timestamp_ns,tx_world_device,ty_world_device,tz_world_device"
    names += ",qx_world_device,qy_world_device,qz_world_device,qw_world_device\n"
    micro = np.round(time * 1e6).astype(np.int64)
    rows = [["a-b", *row] for row in numbers(micro, micro * 0 - 1, t, quat_xyzw(R))]
    return lines(path, rows, names, ",")


# --- headsets: OpenXR's axes (x right, y up, z backward), and Unity's by turning z around ----------------------------

_TO_OPENXR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
_DEVICE = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_HAND_JOINT = {
    "left": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "right": np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
}
"""Columns: the hand joint's x, y (out of the back) and z (to the elbow) in a wrist's own axes, whose T-pose faces x."""
_AIM = {
    "left": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
    "right": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""Columns: x (out of the left palm and of the right hand's back), y (on the thumb's side), z (to the elbow) of a controller
that points along the arm."""
_GRIP = {side: R @ Rotation.from_euler("x", 60, degrees=True).as_matrix() for side, R in _AIM.items()}
"""A grip looks along the tube in the fist, which is turned up by 60 degrees against it."""
_ORIGIN_M = {"wrist": 0.0, "grip": 0.08, "aim": 0.12}
"""Along the hand from the wrist."""


def wrists(time, R, t) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rotations and places of both wrists, which swing before the walking head, the fingers ahead and down."""
    course = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    turn = Rotation.from_euler("z", course[:, None])
    found = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = 0.5 * np.sin(3 * time + sign)
        local = Rotation.from_euler(
            "XYZ", np.stack([sign * -0.6 + 0.1 * swing, 0.5 * swing, sign * -1.2 + 0.5 * swing], 1)
        )
        at = np.stack([0.25 + 0.1 * swing, sign * 0.22 + 0 * swing, -0.55 + 0.05 * swing], 1)
        found[side] = (turn * local).as_matrix(), t + turn.apply(at)
    return found


def headset_poses(time, R, t, convention: str, kind: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Matrices and places of head, left and right in a convention; hands as OpenXR's wrist joints, grips or aims."""
    axes = {"head": _DEVICE} | {"wrist": _HAND_JOINT, "grip": _GRIP, "aim": _AIM}[kind]
    bodies = {"head": (R, t)} | wrists(time, R, t)
    found = {}
    for name, (R_body, t_body) in bodies.items():
        if name != "head":
            t_body = t_body + _ORIGIN_M[kind] * (1.0 if name == "left" else -1.0) * R_body[:, :, 1]
        R_xr, t_xr = _TO_OPENXR @ R_body @ axes[name], t_body @ _TO_OPENXR.T
        flip = np.diag([1.0, 1.0, -1.0 if convention == "unity" else 1.0])
        found[name] = flip @ R_xr @ flip, t_xr @ flip
    return found


def headset_csv(path: Path, time, poses, names: dict[str, str], order: str = "xyzw", between: str = ",") -> Path:
    """A table; `names` gives each device's pattern, such as "head_{quantity}_{axis}", and "time" the first column's name."""
    head, parts = [names["time"]], [time]
    for device, (R, t) in poses.items():
        quantity = names.get("quantities", "pos rot").split()
        head += [names[device].format(quantity=quantity[0], axis=axis) for axis in names.get("axes", "xyz")]
        head += [names[device].format(quantity=quantity[1], axis=axis) for axis in names.get("quat", order)]
        parts += [t, quat_xyzw(R)[:, ["xyzw".index(axis) for axis in order]]]
    return lines(path, numbers(*parts), between.join(head) + "\n", between)


def headset_frames(time, poses, order: str = "xyzw", wrap: str = "") -> list[dict]:
    """Nested frames with arrays."""
    frames = []
    for k, moment in enumerate(time.tolist()):
        devices = {}
        for device, (R, t) in poses.items():
            quat = quat_xyzw(R[k])[["xyzw".index(axis) for axis in order]]
            devices[device] = {"position": t[k].tolist(), "orientation": quat.tolist()}
        frames.append({"timestamp": moment, **({wrap: devices} if wrap else devices)})
    return frames


def exit_code(verb: str, arguments: list[str]) -> int:
    """What a verb of the command line leaves with."""
    from wearcap.cli.main import run_verb

    try:
        return run_verb(verb, arguments) or 0
    except SystemExit as left:
        return int(left.code or 0)
