"""Editing a minute of motion by wrists in the head camera's picture: our solver against 500 plain Adam steps.

Same manifold, windows and energy (MocapEvery eq. 5): a swinging walk at 30 Hz whose right arm is 15° off, and its right
wrist as a detector would find it. value and baseline: seconds. ratio = baseline / value, to be at least `goal`. The
benchmark fails when Adam ends lower.
"""

import math
import sys
import time
from dataclasses import replace

import numpy as np
import torch
from hydra.utils import instantiate
from planted import swinging

from wearcap.body.skeleton import xsens23
from wearcap.cli.conf import compose
from wearcap.geometry import rotation
from wearcap.models.checkpoint import load_trained, shared_checkpoints
from wearcap.recording import Motion, Recording
from wearcap.sensors.keypoints import action_camera, camera_path, seen_joints
from wearcap.systems.mocap_every.energy import LatentSolver
from wearcap.systems.mocap_every.manifold import MotionManifold
from wearcap.systems.mocap_every.visual_cues import VisualCues

NAME = "motion_manifold"
OFF_DEG = 15.0


def measure(duration_s: float = 60.0, steps: int = 500) -> list[dict]:
    motion, recording = _seen(duration_s)
    manifold = _manifold()
    seconds, energies = [], []
    for solver in (LatentSolver(), LatentSolver("adam", steps)):
        editor = VisualCues(manifold, solver=solver)
        editor.edit(motion.sliced(0, 160), recording, motion.sliced(0, 160).joint("head"))
        begin = time.perf_counter()
        _, solutions = editor.edit(motion, recording, motion.joint("head"))
        seconds.append(time.perf_counter() - begin)
        energies.append(sum(solution.history[-1]["total"] for solution in solutions))
    if energies[0] > energies[1]:
        raise SystemExit(f"error: Adam's energy {energies[1]:.4f} is below ours {energies[0]:.4f}")
    return [
        {
            "name": "latent_optimisation_vs_adam",
            "value": seconds[0],
            "unit": f"s (energy {energies[0]:.2f} against {energies[1]:.2f})",
            "baseline": seconds[1],
            "ratio": seconds[1] / seconds[0],
            "goal": 10.0,
        }
    ]


def _seen(duration_s: float) -> tuple[Motion, Recording]:
    """A motion with a wrong right arm, and the recording that saw where its wrist was."""
    recording = swinging("walk", duration_s, 0, fps=30.0)
    truth, head = recording.motion, recording.head
    assert truth is not None
    assert head is not None
    camera = action_camera(head.timestamps)
    cues = seen_joints(
        truth, camera_path(truth, camera), camera.camera, ["right_wrist"], 4.0, 0.1, np.random.default_rng(0)
    )
    R = truth.R_parent_joint.clone()
    elbow, shoulder = truth.skeleton.indices("right_elbow", "right_shoulder")
    for joint in (elbow, shoulder):
        R[:, joint] = R[:, joint] @ rotation.about_axis("z", torch.tensor(math.radians(OFF_DEG)))
    wrong = replace(truth, R_parent_joint=R, contact_prob=torch.zeros(len(truth), 4))
    return wrong, replace(recording, camera=camera, cues=cues)


def _manifold() -> MotionManifold:
    if NAME in shared_checkpoints():
        return load_trained(NAME)[0].net
    torch.manual_seed(0)
    print(f"no checkpoint {NAME!r}: drawn weights", file=sys.stderr)
    config = compose("train", [f"experiment={NAME}"]).model.net
    return instantiate(config)(size=5 + 6 * len(xsens23())).eval()
