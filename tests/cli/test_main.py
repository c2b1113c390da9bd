"""The command: help, version, unknown verbs, exit codes."""

import errno
import sys
import types

import pytest

from wearcap.cli import main as cli
from wearcap.errors import WearcapError


@pytest.fixture
def verb(monkeypatch):
    """Install a verb "doctor" that runs a given function."""

    def install(function):
        module = types.ModuleType("wearcap.cli.doctor")
        module.main = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "wearcap.cli.doctor", module)
        monkeypatch.setattr(cli, "VERBS", {"doctor": "looks"})

    return install


def exit_code(*arguments: str) -> int:
    with pytest.raises(SystemExit) as caught:
        cli.main(list(arguments))
    return caught.value.code  # type: ignore[return-value]


def test_help_lists_the_verbs(verb, capsys):
    verb(print)
    assert exit_code("--help") == 0
    text = capsys.readouterr().out
    assert "doctor     looks" in text
    assert "annotate" not in text


def test_every_verb_has_help_and_main():
    import importlib

    for name in cli.VERBS:
        module = importlib.import_module(f"wearcap.cli.{name}")
        assert callable(module.main)


def test_version(capsys):
    cli.main(["--version"])
    assert capsys.readouterr().out.startswith("wearcap 0.")


def test_no_verb_and_unknown_verb(verb, capsys):
    verb(print)
    assert exit_code() == 2
    assert exit_code("docter") == 2
    assert "Did you mean 'doctor'?" in capsys.readouterr().err


def test_arguments_reach_the_verb(verb):
    seen = []
    verb(seen.extend)
    assert exit_code("doctor", "a=1", "--help") == 0
    assert seen == ["a=1", "--help"]


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (WearcapError("no head", where="a.bvh"), 2, "wearcap doctor: a.bvh: no head.\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (OSError(errno.ENOSPC, "No space", "/x"), 2, "wearcap doctor: /x: the disk is full."),
        (PermissionError(errno.EACCES, "Permission denied", "/x"), 2, "wearcap doctor: /x: no permission."),
        (FileNotFoundError(errno.ENOENT, "No such file", "/x"), 2, "wearcap doctor: /x: No such file."),
    ],
)
def test_errors_become_one_message(verb, capsys, error, code, message):
    def fail(arguments):
        raise error

    verb(fail)
    assert exit_code("doctor") == code
    text = capsys.readouterr().err
    assert text.startswith(message)
    assert text.count("\n") == 1
    assert exit_code("--debug", "doctor") == code
    assert ("Traceback" in capsys.readouterr().err) == (code == 2)


def test_a_bug_keeps_its_traceback(verb):
    def fail(arguments):
        raise ZeroDivisionError

    verb(fail)
    with pytest.raises(ZeroDivisionError):
        cli.main(["doctor"])
