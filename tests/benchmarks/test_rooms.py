"""Every module of benchmarks/ is imported, every benchmark run at its smallest, every table asked for its options."""

import importlib
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.speed import command as speed
from benchmarks.speed.figures import figure
from benchmarks.tables import command as tables

ROOT = Path(__file__).parents[2]
ENTRIES = ("run", "tables")
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted((ROOT / "benchmarks").rglob("*.py"))
    if path.stem != "__init__"
]
KEYS = list(figure("", 0.0, "", 0.0, 0.0, None))
SMALLEST: dict[str, dict] = {
    "capture_runtimes": {"duration_s": 4.0, "rounds": 1, "systems": ("mocap_every",)},
    "carried_heads": {"folders": ()},
    "contact_seconds_per_minute": {"seconds": 2.0, "rounds": 1},
    "contact_sequence_vs_window": {"seconds": 1.0, "rounds": 1},
    "echo_online_small_fps": {"frames": 4, "repeats": 1},
    "faults": {"kills": 0},
    "hmd2_online_full_fps": {"pushes": 1},
    "hmd2_online_small_fps": {"pushes": 1},
    "latent_optimisation_vs_best_adam": {
        "duration_s": 2.0,
        "budget": 3,
        "rates": (1e-2,),
        "decays": (None,),
        "repeats": 1,
    },
    "mocap_every_offline_fps": {"duration_s": 4.0, "repeats": 1},
    "mocap_every_online_fps": {"duration_s": 2.8, "repeats": 1},
    "splat_mpoints_per_second": {"view": 2000, "whole": 4000, "turns": 1},
    "training_whole_vs_before": {
        "datasets": None,
        "experiments": ("motion_diffusion_head",),
        "steps": 6,
        "fixed": 2,
        "cores": None,
    },
    "training_windows_vs_before": {
        "datasets": None,
        "experiments": ("motion_diffusion_head",),
        "batches": 1,
        "rounds": 1,
        "workers": (0,),
        "seconds": 0.1,
    },
    "trajectory_bending_vs_adam": {"duration_s": 10.0, "longest": 10, "repeats": 1},
    "voxelize_frames_per_second": {"points": 2000, "frames": 100},
    "voxelize_vs_brute_force": {"points": 2000, "frames": 100, "compared": 2},
}
"""Arguments of each benchmark that is small in seconds."""
LARGE = {
    "hmd2_runner_vs_eager": "five streams side by side, of up to twenty steps",
    "hps_constants": "simulated sessions of 110 m",
    "hps_end_to_end_realtime": "a filmed session and its map",
    "hps_frames_per_second": "a simulated walk on a scanned floor",
    "hps_online_recovery": "simulated sessions of 130 m",
    "hps_solver_vs_best_adam": "a simulated walk on a scanned floor",
    "ireplica_realtime_factor": "a prepared data set",
    "localization_frames_per_second": "a map of 504 pictures",
    "one_frame_contact": "simulated households, two minutes each",
    "training_data_size": "generated data sets, in processes of their own (tests/benchmarks/test_training_speed.py)",
}
"""Benchmarks that are not, and what they need."""


@pytest.mark.parametrize("module", MODULES)
def test_every_module_is_imported(module):
    importlib.import_module(module)


def test_every_benchmark_is_here():
    assert set(speed.discover()) == {*SMALLEST, *LARGE}
    assert all(benchmark.summary for benchmark in speed.discover().values())


@pytest.mark.parametrize("name", SMALLEST)
def test_a_benchmark_at_its_smallest(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    figures = importlib.import_module(speed.discover()[name].module).measure(**SMALLEST[name])
    assert figures or name == "carried_heads"
    for row in figures:
        assert list(json.loads(json.dumps(row))) == KEYS
        assert row["name"].startswith(name.split("_")[0])
        assert math.isfinite(row["value"])


@pytest.mark.parametrize("system", tables.SYSTEMS)
def test_every_table_says_its_options(system, capsys):
    with pytest.raises(SystemExit) as ended:
        tables.main([system, "--help"])
    assert ended.value.code == 0
    assert "--quick" in capsys.readouterr().out


@pytest.mark.parametrize("name", ENTRIES)
def test_scripts_run_from_the_root(name):
    command = [sys.executable, f"benchmarks/{name}.py", "--help"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert f"{name}.py" in ended.stdout


def test_unknown_names_are_refused(capsys):
    for main, known in ((speed.main, "voxelize_vs_brute_force"), (tables.main, "mocap_every")):
        with pytest.raises(SystemExit) as ended:
            main(["hmd3"])
        assert ended.value.code == 2
        assert known in capsys.readouterr().err
