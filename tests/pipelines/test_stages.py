"""Stages: what is current is reused, a change reaches no further than it must, and a killed run goes on."""

import functools
import io
import os
import signal
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import nn

from wearcap.errors import WearcapError
from wearcap.runtime import stages as digests
from wearcap.runtime.stages import Stage, StageCache, code_digest, digest, modules_of, run_stages
from wearcap.sensors.clock import Clock
from wearcap.systems.ireplica.snapping import HandSnapping

CLOCK = Clock(torch.tensor([1.5, 9.0]).double(), torch.tensor([0.5, 8.0]).double(), 0.1, 0.0, 2)


@dataclass(frozen=True)
class Settings:
    shift: float = 1.0
    gain: float = 2.0
    names: tuple[str, ...] = ("a",)


def three(settings: Settings, made: list[str], die: bool = False) -> list[Stage]:
    """start → doubled (rounded) → end; `made` collects what was made."""

    def start(done):
        made.append("start")
        return replace(CLOCK, camera_s=CLOCK.camera_s + settings.shift)

    def doubled(done):
        made.append("doubled")
        return {"value": (settings.gain * done["start"].camera_s).round()}

    def end(done):
        if die:
            os.kill(os.getpid(), signal.SIGKILL)
        made.append("end")
        return None if settings.gain == 0 else done["doubled"]["value"].sum().item()

    return [
        Stage("start", start, lambda: [settings.shift], kinds=(Clock,)),
        Stage("doubled", doubled, lambda: [settings.gain], ("start",)),
        Stage("end", end, list, ("doubled",)),
    ]


def run(cache, settings=Settings(), until=None):
    made, shown = [], Console(file=io.StringIO(), width=200)
    results, runs = run_stages(three(settings, made), StageCache(cache), until, shown)
    assert [r["reused"] for r in runs] == [r["stage"] not in made for r in runs]
    return results, made, shown.file.getvalue().splitlines()


def test_what_is_current_is_reused(tmp_path):
    first, made, _ = run(tmp_path)
    assert made == ["start", "doubled", "end"]
    again, made, lines = run(tmp_path)
    assert made == []
    assert lines == ["start: reused", "doubled: reused", "end: reused"]
    assert torch.equal(again["start"].camera_s, first["start"].camera_s)
    assert (again["start"].drift_s_per_hour, again["end"]) == (0.1, first["end"])
    assert not list(tmp_path.glob(".*"))


def test_a_change_reaches_what_follows_as_far_as_it_tells(tmp_path):
    run(tmp_path)
    assert run(tmp_path, Settings(gain=3.0))[1] == ["doubled", "end"]
    # Another start that rounds to the same: the last stage has nothing new to read.
    assert run(tmp_path, Settings(shift=1.001))[1] == ["start", "doubled"]
    assert run(tmp_path)[1] == []


def test_it_stops_after_the_stage_asked_for(tmp_path):
    results, made, _ = run(tmp_path, until="doubled")
    assert made == list(results) == ["start", "doubled"]
    assert run(tmp_path)[1] == ["end"]
    with pytest.raises(WearcapError, match="no stage 'dubled'. Expected one of start, doubled, end"):
        run(tmp_path, until="dubled")


def test_nothing_as_a_result_is_kept_too(tmp_path):
    assert run(tmp_path, Settings(gain=0.0))[0]["end"] is None
    assert run(tmp_path, Settings(gain=0.0))[1] == []


def cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def flip(path):
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(bytes(content))


def rename(path):
    path.write_bytes(path.read_bytes().replace(b"$tensor", b"$tenser"))


@pytest.mark.parametrize("damage", [cut, flip, rename, os.remove], ids=["cut", "flipped", "renamed", "gone"])
def test_a_damaged_result_is_made_again_with_a_note(damage, tmp_path):
    run(tmp_path)
    (path,) = tmp_path.glob("doubled-*.safetensors")
    damage(path)
    _, made, lines = run(tmp_path)
    assert made == ["doubled"]
    noted = [line for line in lines if "it is made again" in line]
    assert len(noted) == (damage is not os.remove)
    assert run(tmp_path)[1] == []


def test_a_killed_run_goes_on_where_it_stood(tmp_path):
    child = os.fork()
    if child == 0:
        run_stages(three(Settings(), [], die=True), StageCache(tmp_path))
        os._exit(0)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    results, made, _ = run(tmp_path)
    assert made == ["end"]
    assert results["end"] == run_stages(three(Settings(), []))[0]["end"]


def test_digests_follow_content(tmp_path):
    file = tmp_path / "a.bin"
    file.write_bytes(b"a")
    part = functools.partial(run, settings=Settings())
    values = [
        1,
        1.0,
        True,
        "1",
        None,
        [1],
        [[1]],
        {"a": 1},
        torch.ones(2),
        torch.ones(2, 1),
        torch.ones(2).double(),
        np.ones(2),
        Settings(),
        Settings(gain=3.0),
        file,
        part,
        run,
        nn.Linear(2, 1),
        torch.float32,
        torch.float64,
    ]
    seen = [digest(value) for value in values]
    assert len(set(seen)) == len(values)
    assert seen == [digest(value) for value in values]
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    assert digest(part) == digest(functools.partial(run, settings=Settings()))
    before = digest(file)
    file.write_bytes(b"bb")
    assert digest(file) != before
    for wrong in (lambda: 0, object()):
        with pytest.raises(TypeError):
            digest(wrong)
    with pytest.raises(WearcapError, match="no such file"):
        digest(tmp_path / "none")


def test_the_code_of_a_stage_is_all_that_its_module_imports(tmp_path, monkeypatch):
    """A change of any module that is imported, however far below, changes the digest; another one does not."""
    package = tmp_path / "wearcap"
    sources = {
        "top": "from wearcap.middle import run",
        "middle": "import wearcap.deep.bottom",
        "deep/__init__": "",
        "deep/bottom": "VALUE = 1",
        "aside": "",
    }
    for name, text in sources.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / f"{name}.py").write_text(text)
    monkeypatch.setattr(digests, "PACKAGE", package)

    def found() -> str:
        digests.code_digest.cache_clear()
        digests._imports.cache_clear()
        return code_digest("wearcap.top")

    before = found()
    (package / "aside.py").write_text("VALUE = 2")
    assert found() == before
    (package / "deep" / "bottom.py").write_text("VALUE = 22")
    assert found() != before
    with pytest.raises(WearcapError, match="no module 'wearcap.none'"):
        code_digest("wearcap.none")
    digests.code_digest.cache_clear()
    digests._imports.cache_clear()


def test_the_modules_of_what_a_stage_reads():
    energy = functools.partial(code_digest, HandSnapping())
    assert modules_of([energy, {"a": torch.ones(2)}, 3]) == {
        "wearcap.runtime.stages",
        "wearcap.systems.ireplica.snapping",
        "wearcap.systems.ireplica.contact_correction",
    }
