"""Installs the wheel in fresh environments, one per extra, and uses it in an empty folder: what a new user does.

    python -m release.install [EXTRA …] [--wheel FILE] [--torch torch==2.13.0] [--folder DIR]

Without EXTRA: core, train, view, live, scene, export, all. PyTorch is installed first: size (MB) and time (s) are of what comes after it. One
JSON line per environment; the exit code is 1 if something failed.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
WALK = "headset_walk.csv"
CAPTURE = ["wearcap", "capture", f"recording={WALK}", "height=1.74", "output=out"]
LOAD = "import wearcap; assert len(wearcap.load('echo')(wearcap.read('headset_walk.csv', height=1.74))) > 400"
LEAN = "import importlib.util as u; assert not [m for m in ('lightning', 'viser', 'cv2', 'onnx', 'anny', 'warp') if u.find_spec(m)]"
SIFT = "import numpy as np; from wearcap.localization.features import RootSift; RootSift()(np.zeros((64, 64, 3), np.uint8))"
CORE = (CAPTURE, ["wearcap", "render", WALK, "motion=out/motion.npz", "frames=2", "out=x.png"], ["python", "-c", LOAD])
TRAIN = "import wandb, prodigyopt, wearcap.cli.adapt, wearcap.cli.train, wearcap.training.loggers, hydra_plugins.hydra_joblib_launcher"
CHECKS: dict[str, tuple[list[str], ...]] = {
    "core": (*CORE, ["python", "-c", LEAN]),
    "train": (["python", "-c", TRAIN], ["wearcap", "train", "data=simulated", "--cfg", "job"]),
    "view": (["python", "-c", "import wearcap.cli.view, wearcap.cli.scene_edit, wearcap.apps.scene_editor.editor"],),
    "live": (["python", "-c", "import wearcap.cli.live"],),
    "scene": (["python", "-c", SIFT], ["python", "-c", "import poselib, wearcap.cli.scene, wearcap.cli.track"]),
    "export": (["wearcap", "export", "checkpoint=echo", "format=onnx", "output=echo.onnx"],),
}
CHECKS["all"] = (*CORE, *(check for name in list(CHECKS)[1:] for check in CHECKS[name]))
"""Commands of each environment, run in an empty folder with the sample beside them."""
QUICK = {
    "import_s": ["python", "-c", "import wearcap"],
    "torch_s": ["python", "-c", "import torch"],
    "doctor_s": ["wearcap", "doctor", WALK],
}
"""Commands that are timed: the fastest of three."""


def size_mb(folder: Path) -> float:
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_symlink()) / 1e6


def run(command: list[str], place: Path, environment: Path) -> str:
    """Run a command of an environment in a folder; returns its messages when it failed, else ""."""
    scripts = environment / ("Scripts" if os.name == "nt" else "bin")
    plain = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    variables = plain | {"WEARCAP_CACHE": str(place / "cache"), "no_proxy": "*"}
    ended = subprocess.run(
        [scripts / command[0], *command[1:]], cwd=place, env=variables, capture_output=True, text=True
    )
    return "" if ended.returncode == 0 else f"{' '.join(command)[:80]}: {ended.stderr[-800:]}"


def fastest(command: list[str], place: Path, environment: Path) -> float:
    times = []
    for _ in range(3):
        began = time.perf_counter()
        run(command, place, environment)
        times.append(time.perf_counter() - began)
    return round(min(times), 2)


def tried(extra: str, wheel: Path, torch: str, folder: Path) -> dict:
    """Figures and failures of one environment, which is removed afterwards."""
    environment, place = folder / extra, folder / f"{extra}-empty"
    venv.create(environment, with_pip=True)
    place.mkdir()
    shutil.copy(ROOT / "examples" / WALK, place)
    pip = ["python", "-m", "pip", "install", "--quiet"]
    failures = [run([*pip, torch], place, environment)]
    before, began = size_mb(environment), time.perf_counter()
    failures += [run([*pip, str(wheel) if extra == "core" else f"{wheel}[{extra}]"], place, environment)]
    figures = {"install_s": round(time.perf_counter() - began, 1), "size_mb": round(size_mb(environment) - before)}
    for check in CHECKS[extra] if not any(failures) else ():
        failures.append(run(check, place, environment))
    if extra == "core" and not any(failures):
        figures |= {name: fastest(command, place, environment) for name, command in QUICK.items()}
    shutil.rmtree(environment)
    return {"extra": extra, **figures, "failures": [each for each in failures if each]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("extras", nargs="*", default=list(CHECKS), help=", ".join(CHECKS))
    parser.add_argument("--wheel", type=Path, help="default: built from this checkout")
    parser.add_argument("--torch", default="torch", help="requirement of PyTorch")
    parser.add_argument("--folder", type=Path, help="where environments are made (default: a temporary folder)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder, prefix="wearcap-install-") as made:
        folder, wheel = Path(made), options.wheel
        if wheel is None:
            subprocess.run(
                [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder], cwd=ROOT, check=True
            )
            wheel = next(folder.glob("*.whl"))
        failed = False
        for extra in options.extras:
            found = tried(extra, wheel.absolute(), options.torch, folder)
            print(json.dumps(found), flush=True)
            failed |= bool(found["failures"])
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
