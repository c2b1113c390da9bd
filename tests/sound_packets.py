"""Sound packets of every source of `wearcap live`, by frame."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path[:0] = [str(Path(__file__).resolve().parent / "live")]

import mvn_datagrams  # noqa: E402
import test_sources_osc as osc  # noqa: E402
import test_sources_watches as watches  # noqa: E402


def vmc(frame: int) -> list[bytes]:
    turn, place = Rotation.from_rotvec([0, 0, frame / 60]), np.array([0.1, 0.2, 1.6])
    parts = [osc.device(kind, name, turn, place) for kind, name in (("Hmd/Pos", "h"), ("Con/Pos", "LeftHand"))]
    parts += [osc.device("Tra/Pos/Local", "LHR-1", turn, place), osc.message("/VMC/Ext/T", frame / 60)]
    return [osc.bundle(*parts), parts[0], osc.bundle(osc.bundle(parts[1]), parts[2])]


def osctrackers(frame: int) -> list[bytes]:
    p, e = osc.unity_euler(Rotation.from_rotvec([0, 0, frame / 60]), np.array([0.1, 0.2, 1.6]))
    halves = [osc.tracker(name, half, v) for name in ("head", "1") for half, v in (("position", p), ("rotation", e))]
    return [osc.bundle(*halves), halves[0], halves[1]]


def mvn(frame: int) -> list[bytes]:
    pose = mvn_datagrams.pose(frame, frame, 16 * frame)
    return [*pose, *mvn_datagrams.pose(frame + 1000, frame, 16 * frame, 1, 2), *mvn_datagrams.size()]


def watch(frame: int) -> list[bytes]:
    row = MOVING[frame % len(MOVING)]
    row = (row[0] + len(MOVING) / 100 * (frame // len(MOVING)), *row[1:])
    whole = {"name": "wrist motion", "time": round(row[0] * 1e9), "values": watches.wrist_motion(row, True, False)}
    log = watches.sensor_log(row, True)
    header = ",".join(key + "(G)" for key in log)
    line = ",".join(map(str, log.values()))
    apart = [
        {"name": "orientation", "time": whole["time"], "values": dict(zip(("qx", "qy", "qz", "qw"), row[1].as_quat()))},
        {"name": "gravity", "time": whole["time"], "values": {"x": 0.1, "y": 0.1, "z": 9.8}},
        {"name": "accelerometer", "time": whole["time"], "values": {"x": 0.1, "y": 0.1, "z": 0.1}},
    ]
    texts = [watches.posted([whole], "left"), json.dumps(log).encode(), f"{header}\n{line}\n".encode(), line.encode()]
    return [*texts, watches.posted(apart, "phone")]


def messages(points: int) -> Callable[[int], list[bytes]]:
    def sound(frame: int) -> list[bytes]:
        pose = {"position": [0.1, 0.2, 1.6], "rotation_wxyz": [1, 0, 0, 0], "time": frame / 60}
        cloud = [[0.1 * k, 1.5, 2.25] for k in range(points)]
        found = [
            {"device": "head", "floor": 0.0, "points": cloud, **pose},
            {"device": "left_wrist", "axes": "unity", "wearer": "anna", "clock": "c", **pose},
            {"device": "w", "acceleration": [1, 2, 3], "matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "time": frame / 60},
            {"device": "camera", "confidence": 0.5, **pose},
            {"object": "box_1", "axes": "openxr", **pose},
            {"active_object": "box_1" if frame % 2 else None, "time": frame / 60},
        ]
        return [json.dumps(each).encode() for each in found]

    return sound


def requests(frame: int) -> list[bytes]:
    found = []
    for number, body in enumerate(watch(frame)[:2]):
        head = f"POST /data HTTP/1.1\r\nHost: 127.0.0.1:8000\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n"
        head += "Connection: close\r\n" if number else ""
        found.append(head.encode() + b"\r\n" + body)
    return [*found, found[0] * 2]


MOVING = watches.moving(400)
SOUND = {
    "vmc": vmc,
    "osctrackers": osctrackers,
    "mvn": mvn,
    "watch": watch,
    "watch+http": requests,
    "json": messages(5),
    "ws": messages(60),
}
