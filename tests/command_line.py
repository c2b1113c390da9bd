"""Commands as a user types them: their exit code, and what they leave behind."""

from pathlib import Path

import pytest

from wearcap.cli import main as cli


def exit_code(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    return int(caught.value.code or 0)


def files_in(folder: Path) -> set[str]:
    """What a run left, but for Hydra's and our own record of it."""
    kept = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    return {
        name
        for name in kept
        if not name.startswith((".hydra/", "run.json", "config.yaml")) and not name.endswith(".log")
    }
