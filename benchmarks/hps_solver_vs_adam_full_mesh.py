"""HPS: our banded second-order solver against the paper's Adam over windows, same recording, same energy.

The energy is the paper's (conf/problem/hps_paper.yaml), the recording a simulated walk of 60 s at 30 Hz with a
scanned floor. Adam takes 500 steps per window of 100 frames and skins a whole body of SMPL's size (6890 vertices) at
each, in single precision on both cores; it is run on the first two windows, since the whole takes hours. Ours solves
the whole recording. Energies are compared on those two windows; the benchmark fails when ours is higher.
value and baseline: ms per frame. ratio = baseline / value, to be at least `goal`. A second figure (no goal) has
Adam see the feet's patches alone, the honest middle.
"""

import os
import time

import numpy as np
import torch
from hydra.utils import instantiate

from wearcap.body.anny_body import anny_body
from wearcap.cli.conf import compose
from wearcap.geometry import rotation
from wearcap.geometry.surface import SurfaceIndex
from wearcap.optimize.adam_windows import AdamSettings, solve_adam_windows
from wearcap.optimize.banded import BandedSettings, solve_in_stretches
from wearcap.optimize.hps import FootPatches, HpsData, HpsEnergy, HpsState, SuitSteps, energy_terms
from wearcap.simulation.recordings.simulate import SimulationConfig, simulate_recording
from wearcap.systems.hps.pipeline import turns

WINDOWS = slice(0, 199)


def measure(duration_s: float = 60.0, steps: int = 500) -> list[dict]:
    energy = paper_energy()
    data = walk(duration_s, vertices=6890)
    settings = BandedSettings(iterations=20, relaxation=1.5)

    def ours() -> HpsState:
        return solve_in_stretches(energy, data, settings, stretch=len(data) // 2, jobs=os.cpu_count() or 1).state

    ours()  # compiled, and its memory warm
    begin = time.perf_counter()
    state = ours()
    value = 1000 * (time.perf_counter() - begin) / len(data)
    ours_energy = total(energy, data[WINDOWS], state[WINDOWS])
    figures = []
    for name, full, goal in (("", True, 300.0), ("_patches", False, None)):
        begin = time.perf_counter()
        adam = solve_adam_windows(energy, data[WINDOWS], AdamSettings(steps=steps, full_mesh=full))
        baseline = 1000 * (time.perf_counter() - begin) / len(data[WINDOWS])
        adam_energy = total(energy, data[WINDOWS], adam.state)
        if ours_energy > adam_energy:
            raise SystemExit(f"error: our energy {ours_energy:.4f} is above Adam's {adam_energy:.4f}")
        figures.append(
            {
                "name": f"hps_solver_vs_adam{name or '_full_mesh'}",
                "value": value,
                "unit": f"ms per frame (energy {ours_energy:.3f} against {adam_energy:.3f})",
                "baseline": baseline,
                "ratio": baseline / value,
                "goal": goal,
            }
        )
    return figures


def paper_energy() -> HpsEnergy:
    config = compose("capture", ["pipeline=paper/hps", "recording=none"])
    return instantiate(config.pipeline.energy, _convert_="all")


def total(energy: HpsEnergy, data: HpsData, state: HpsState) -> float:
    with torch.no_grad():
        return float(torch.stack(list(energy_terms(energy, data, state).values())).sum())


def walk(duration_s: float, vertices: int | None = None, seed: int = 3) -> HpsData:
    """A simulated wearer's suit on a scanned floor, localised to 5 cm and 1°."""
    rng = np.random.default_rng(seed)
    config = SimulationConfig(duration_s=duration_s, fps=30.0, points=False, world="flat", activities=("walk", "stand"))
    recording = simulate_recording(config, "walk", "train", seed)
    suit, true = recording.suit, recording.motion
    assert suit is not None
    assert true is not None
    R, length = suit.R_parent_joint.double(), len(suit)
    t = true.t_world_root.double() + torch.from_numpy(rng.normal(0, 0.03, (length, 3)))
    head = suit.joint("head").R.double()
    R_cam = true.joint("head").R.double() @ rotation.exp(torch.from_numpy(rng.normal(0, 0.01, (length, 3))))
    one = torch.ones(length, dtype=torch.float64)
    low, high = (getattr(true.t_world_root, end)(0).values[:2].numpy() for end in ("min", "max"))
    count = int(np.prod(high - low + 3.0) / 0.01**2)
    floor = np.column_stack([rng.uniform(low - 1.5, high + 1.5, (count, 2)), rng.normal(0, 0.002, count)])
    assert suit.contact_prob is not None
    return HpsData(
        FootPatches.of(anny_body(suit.skeleton, recording.shape, vertices)),
        HpsState(rotation.log(R[:, 1:]), R[:, 0], t),
        torch.eye(3, dtype=torch.float64),
        R_cam,
        one,
        one.clone(),
        suit.contact_prob.double(),
        SuitSteps(suit.t_world_root.double().diff(dim=0), turns(R[:, 0]), turns(head)),
        SurfaceIndex.build(floor.astype(np.float32)),
    )
