"""The commands of README.md and docs/: their verbs exist, their overrides compose, their arguments parse."""

import importlib
import shlex
from pathlib import Path

import pytest

from wearcap.cli import main as cli
from wearcap.cli.conf import compose, conf_dir
from wearcap.cli.live import with_system
from wearcap.errors import WearcapError

ROOT = Path(__file__).parents[1]
HYDRA_VERBS = ("train", "evaluate", "capture", "export")


def commands(text: str) -> list[str]:
    """Lines of code blocks that start with one of our commands, without their comments."""
    blocks = text.split("```")[1::2]
    lines = [line.split(" #")[0].strip() for block in blocks for line in block.splitlines()]
    scripts = tuple(f"python {verb}.py" for verb in HYDRA_VERBS)
    return [
        line.removeprefix("$ ") for line in lines if line.removeprefix("$ ").startswith(("wearcap ", "make ", *scripts))
    ]


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = [(page.name, line) for page in PAGES for line in commands(page.read_text(encoding="utf-8"))]


def composes(config: str, arguments: list[str]) -> None:
    """Overrides compose; of a sweep's values each first one, and what the reader fills in (…) is left out."""
    sweep = "-m" in arguments
    overrides = [argument for argument in arguments if "=" in argument and "…" not in argument]
    compose(config, [o.split(",")[0] if sweep and "[" not in o else o for o in overrides])


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{page}: {line}" for page, line in COMMANDS])
def test_a_command_of_the_pages_is_understood(page, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, verb, *arguments = shlex.split(line)
    if first == "make":
        assert f"\n{verb}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
        return
    if first == "python":
        assert (ROOT / verb).is_file()
        verb = verb.removesuffix(".py")
    assert verb in cli.VERBS
    if verb in HYDRA_VERBS:
        composes(verb, arguments)
    elif verb == "live":
        composes("live", with_system(arguments))
    elif verb == "prepare":
        composes("prepare", [f"prepare={arguments[0]}", *arguments[1:]])
    elif verb != "demo":
        with pytest.raises(WearcapError):  # the recording is not there; what does not parse ends in SystemExit
            importlib.import_module(f"wearcap.cli.{verb}").main(arguments)


def test_the_pages_name_the_main_commands():
    named = " ".join(line for _, line in COMMANDS)
    for word in (
        "make demo",
        "make test",
        "prepare cmu",
        "train.py",
        "evaluate.py",
        "capture.py",
        "export.py",
        "wearcap view",
        "wearcap render",
        "wearcap doctor",
        "launcher=joblib",
        "launcher=slurm",
    ):
        assert word in named


@pytest.mark.parametrize("launcher", ["joblib", "slurm", "submitit_local"])
def test_a_launcher_composes(launcher):
    import hydra

    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = hydra.compose(
            "train", ["experiment=motion_diffusion_head", f"hydra/launcher={launcher}"], return_hydra_config=True
        )
    target = config.hydra.launcher._target_
    assert hydra.utils.get_class(target).__name__ in ("JoblibLauncher", "SlurmLauncher", "LocalLauncher")
