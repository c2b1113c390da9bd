"""A small data set to annotate, an annotator that serves it, and requests to it."""

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import torch

from wearcap.apps.annotate.server import AnnotationServer
from wearcap.apps.annotate.takes import Desk
from wearcap.geometry.camera import Camera
from wearcap.io.formats.contact_labels import Label, LabelClock, annotation_of
from wearcap.recording import CameraStream, RecordingStore
from wearcap.recording.motion import Interactions
from wearcap_testing import recording_of, swaying_motion

FRAMES, FPS = 600, 60.0
TIMES = torch.arange(FRAMES, dtype=torch.float64) / FPS
CLOCK = LabelClock.of("r0", TIMES)


def held(start: list[float], stop: list[float], hands: list[list[bool]], object_name: str = "") -> Interactions:
    kind = "sliding" if object_name else ""
    return Interactions(
        torch.tensor(start).double(),
        torch.tensor(stop).double(),
        torch.tensor(hands, dtype=torch.bool).reshape(-1, 2),
        (object_name,) * len(start),
        (kind,) * len(start),
    )


def a_film(path: Path, seconds: float = 10.0, fps: int = 30) -> Path:
    """A video whose brightness is its time."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264" if "libx264" in av.codecs_available else "mpeg4", rate=fps)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for number in range(round(seconds * fps)):
            picture = np.full((120, 160, 3), 40 + int(180 * number / (seconds * fps)), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def write_flat(root: Path) -> Path:
    """Recordings r0 (with a camera's video) and r1 (without), and r0's objects."""
    store = RecordingStore(root)
    a_film(root / "r0.mp4")
    stamps = torch.arange(300, dtype=torch.float64) / 30
    camera = CameraStream(
        stamps, Camera("pinhole", 160, 120, 100.0, 100.0, 79.5, 59.5), torch.eye(3), torch.zeros(3), video="r0.mp4"
    )
    for number in range(2):
        recording = recording_of(swaying_motion(FRAMES, number, FPS), f"r{number}")
        if number == 0:
            sofa = held([2.0], [4.0], [[True, True]], "sofa")
            recording = replace(recording, camera=camera, interactions=sofa)
        store.add(recording, split="test", config_hash="x")
    return root


@contextmanager
def served(dataset: Path, output: Path, where: str = "", **options) -> Iterator[AnnotationServer]:
    server = AnnotationServer(Desk(dataset / where, output, **options), port=18300)
    try:
        yield server
    finally:
        server.stop()


def ask(server: AnnotationServer, method: str, path: str, body: object = None, **headers: str):
    """Status, headers and body of a request, with the cookie of a page that was opened by its address."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    text = None if body is None else body if isinstance(body, str) else json.dumps(body)
    given = {"Cookie": f"wearcap_token_{server.server_port}={server.guard.token}"}
    given |= ({"Content-Type": "application/json"} if text is not None else {}) | {
        key.replace("_", "-"): value for key, value in headers.items()
    }
    connection.request(method, path, text, given)
    reply = connection.getresponse()
    data = reply.read()
    connection.close()
    return reply.status, reply.headers, data


def labels(left=(), right=(), clock: LabelClock = CLOCK) -> dict:
    return annotation_of({"left": tuple(Label(*s) for s in left), "right": tuple(Label(*s) for s in right)}, clock)
