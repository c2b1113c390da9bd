"""Checks everything that a release needs, builds it, and prints the commands that publish it: `make release`.

    python -m release [--rehearse]

`--rehearse` goes on where a check fails, and says at the end which.
"""

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path

from release.registry import FOLDER, registry
from wearcap.version import __version__

ROOT = Path(__file__).parents[1]


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def newest(changelog: str) -> tuple[str, str]:
    """(version, date) of a changelog's first entry; the date of one that is not released is "unreleased"."""
    found = re.search(r"^## (\d+\.\d+\.\d+) - (\S+)$", changelog, re.MULTILINE)
    return (found[1], found[2]) if found else ("", "")


def faults() -> list[str]:
    """What stands against a release of this checkout."""
    version, date = newest((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    checks = {
        "the tree has changes that are not committed": bool(git("status", "--porcelain")),
        f"CHANGELOG.md begins with {version or 'no version'}, the package is {__version__}": version != __version__,
        f"CHANGELOG.md has no date for {version}": not re.fullmatch(r"\d{4}-\d\d-\d\d", date),
        f"the tag v{__version__} exists": bool(git("tag", "--list", f"v{__version__}")),
        "checkpoints/registry.json is old: python -m release.registry": (FOLDER / "registry.json").read_text(
            encoding="utf-8"
        )
        != registry(),
    }
    return [fault for fault, found in checks.items() if found]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rehearse", action="store_true", help="go on where a check fails")
    parser.add_argument("--torch", default="torch", help="requirement of PyTorch for the tests of the wheel")
    options = parser.parse_args()
    found = faults()
    if found and not options.rehearse:
        print("no release:", *found, sep="\n  ", file=sys.stderr)
        return 1
    dist = ROOT / "dist" / f"wearcap-{__version__}"
    shutil.rmtree(dist, ignore_errors=True)
    python = [sys.executable, "-m"]
    steps = [
        [*python, "build", "--outdir", str(dist)],  # the wheel from the sdist
        [
            *python,
            "twine",
            "check",
            "--strict",
            f"{dist}/wearcap-{__version__}.tar.gz",
            f"{dist}/wearcap-{__version__}-py3-none-any.whl",
        ],
        [
            *python,
            "release.install",
            "--torch",
            options.torch,
            "--wheel",
            f"{dist}/wearcap-{__version__}-py3-none-any.whl",
        ],
    ]
    for step in steps:
        if subprocess.run(step, cwd=ROOT).returncode:
            found.append(f"failed: {' '.join(step[2:4])}")
            if not options.rehearse:
                break
    if found:
        print("no release:", *found, sep="\n  ", file=sys.stderr)
        return 1
    print(
        f"\nAll checks passed. To publish:\n  git tag v{__version__} && git push origin v{__version__} && twine upload {dist}/*"
    )
    print(
        f"  hf upload wearcap/wearcap checkpoints . --include '*.safetensors' '*.md' && hf repo tag create wearcap/wearcap v{__version__}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
