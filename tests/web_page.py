"""What tests of the browser's page share: npm's packages, an exported folder, the page's modules under node, a server of files."""

import functools
import json
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch

from small_hmd2 import hmd2_of
from wearcap.export.web import page_exports, require_libraries, write_page
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.rotation import matrix_from_quat_wxyz
from wearcap.geometry.trajectory import Trajectory
from wearcap.models.layers import TransformerSize
from wearcap.recording import Recording
from wearcap.systems.hmd2.features import HeadFeatures
from wearcap.systems.hmd2.model import MotionDenoiser
from wearcap.systems.hmd2.pipeline import HMD2
from wearcap.tracking.foot_lock import FootLock
from wearcap.tracking.refinement import Refinement
from wearsim.recordings.simulate import SimulationConfig, simulate_recording

ROOT = Path(__file__).parents[1]
SCRIPT = Path(__file__).with_name("web_page.mjs")


def node_modules() -> Path:
    """Folder of npm's packages. Skips the test where they are not installed."""
    folder = Path(os.environ.get("WEARCAP_NODE_MODULES") or ROOT / "integrations/web/node_modules")
    if not (folder / "onnxruntime-web").is_dir():
        pytest.skip("no packages of the page: run `npm ci` in integrations/web")
    require_libraries(folder)
    return folder


def small_system(**settings) -> HMD2:
    """A small network with random weights that do say something, which knows heads, hands and images."""
    torch.manual_seed(0)
    features = HeadFeatures(contacts=True, body=True, spread=True)
    sizes = features.motion_size, features.condition_size, 24, TransformerSize(32, 1, 2, 64, 0.1)
    net = MotionDenoiser(*sizes, frames_per_token=2, blend=5, conditions={"image": 8, "hands": 20})
    with torch.no_grad():
        net.head.weight.normal_(std=0.3)
    still = torch.eye(3).repeat(1, 1, features.joints, 1, 1)
    mean = features.encode(still, still[:, :, 0], torch.full((1, 1, 2), 0.5))[0, 0]
    net.motion_normalizer.set(mean, torch.full((features.motion_size,), 0.15))  # people bend, but are not torn
    feet = FootLock(0.5, 0.4, 2, 2, 2, 30.0, 0.2, 5.0, 0.05, 0.2)
    defaults = {"stride": 6, "lookahead": 8, "fade": 4, "refinement": Refinement(0.6, feet, False), "live": True}
    return hmd2_of(net, features, image_encoder="egoview", use=["hands"], **(defaults | settings))


def simulated(seconds: float = 5.0, seed: int = 7) -> Recording:
    """A simulated walk whose wrists are tracked."""
    settings = SimulationConfig(duration_s=seconds, points=False, activities=("walk",), world="flat")
    return with_true_wrists(simulate_recording(settings, "walk", "test", seed))


def with_true_wrists(recording: Recording) -> Recording:
    motion = recording.motion
    assert motion is not None
    T, names = motion.T_world_joint, ("left_wrist", "right_wrist")
    at = {name: motion.skeleton.index(name) for name in names}
    return replace(
        recording,
        tracked={name: Trajectory(motion.timestamps, T.R[:, joint], T.t[:, joint]) for name, joint in at.items()},
    )


def write(system: HMD2, folder: Path, recording: Recording) -> Path:
    """The folder of a system's page."""
    write_page(page_exports(system), folder, recording, node_modules())
    return folder


def in_node(page: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run `web_page.mjs` with the page's own modules. Skips the test without node."""
    if not shutil.which("node"):
        pytest.skip("no node found")
    command = ["node", str(SCRIPT), str(page), str(node_modules()), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def answer(page: Path, *arguments: object):
    """What it prints, as JSON."""
    found = in_node(page, *arguments)
    assert found.returncode == 0, found.stderr[-2000:]
    return json.loads(found.stdout)


def poses_of(track: dict) -> Rigid:
    """Poses of a path as the page holds it."""
    rows = torch.tensor(track["poses"], dtype=torch.float64)
    return Rigid(matrix_from_quat_wxyz(rows[:, 3:].roll(1, -1)), rows[:, :3])


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, ThreadingHTTPServer, list[str]]]:
    """Address, server and requested paths of a plain server of files, which the test may shut down."""
    asked: list[str] = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            asked.append(self.path)

    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/", server, asked
    finally:
        server.shutdown()
        server.server_close()
