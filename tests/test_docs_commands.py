"""The commands of README.md and docs/: their verbs exist, their overrides compose, their arguments parse."""

import re
import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from wearcap.cli import main as cli
from wearcap.cli.conf import compose, conf_dir
from wearcap.cli.live import with_system
from wearcap.cli.verbs import VERBS, overrides

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
    """Overrides compose, and all values are there; of a sweep's values each first one, and what the reader fills in (…)
    is left out."""
    sweep = "-m" in arguments
    overrides = [argument for argument in arguments if "=" in argument and "…" not in argument]
    made = compose(config, [o.split(",")[0] if sweep and "[" not in o else o for o in overrides])
    if config == "prepare":
        OmegaConf.to_container(made, resolve=True, throw_on_missing=True)


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{page}: {line}" for page, line in COMMANDS])
def test_a_command_of_the_pages_is_understood(page, line, tmp_path, monkeypatch):
    """In a clean folder, up to the first input that is not there, and nothing is left."""
    monkeypatch.chdir(tmp_path)
    first, verb, *arguments = shlex.split(line)
    if first == "make":
        assert f"\n{verb}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
        return
    if first == "python":
        assert (ROOT / verb).is_file()
        verb = verb.removesuffix(".py")
    assert verb in VERBS
    given = overrides(verb, arguments)
    if verb in HYDRA_VERBS:
        composes(verb, given)
    elif verb == "live":
        composes("live", with_system(given))
    elif verb == "prepare":
        composes("prepare", [f"prepare={given[0]}", *given[1:]])
    elif verb != "demo":
        assert cli.run_verb(verb, arguments) == cli.USER_ERROR  # the recording is not there
    assert not list(tmp_path.iterdir())


BROUGHT = {"own", "seen_hands", "echo"}
"""Data sets in `datasets/` that the reader brings."""


def test_a_page_makes_its_data_sets_before_it_uses_them():
    made_by: dict[str, list[tuple[str, int]]] = {}
    for number, (page, line) in enumerate(COMMANDS):
        words = shlex.split(line)
        if words[:2] == ["wearcap", "prepare"]:
            output = next((w for w in words if w.startswith("output=")), f"output=datasets/{words[2]}")
            made_by.setdefault(output.removeprefix("output=datasets/"), []).append((page, number))
    for number, (page, line) in enumerate(COMMANDS):
        used = set(re.findall(r"(?<!output=)datasets/(\w+)", line)) - BROUGHT
        for name in used:
            assert name in made_by, f"{page}: {line}: no page makes datasets/{name}"
            here = [place for of, place in made_by[name] if of == page]
            assert not here or min(here) <= number, f"{page}: {line}: datasets/{name} is made further down"


@pytest.mark.slow
def test_the_first_commands_of_live_run_as_written(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    lines = [line for page, line in COMMANDS if page == "live.md"]
    first = next(number for number, line in enumerate(lines) if " prepare " in line)
    for line, more in zip(lines[first : first + 2], ([], ["seconds=2"])):
        _, verb, *arguments = shlex.split(line)
        assert cli.run_verb(verb, [*arguments, *more]) == 0
    assert "frames, latency" in capfd.readouterr().out


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
