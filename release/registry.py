"""The registry of shared checkpoints, `checkpoints/registry.json`, from the files beside it.

    python -m release.registry

The wheel carries this list in place of the files, and fetches those that are used. `urls` are the mirrors, in the layout of the
Hugging Face hub; {version} is the version that is installed.
"""

import json
from pathlib import Path

from wearcap.files import sha256_of, write_text

FOLDER = Path(__file__).parents[1] / "checkpoints"
URLS = ("https://huggingface.co/wearcap/wearcap/resolve/v{version}/{name}.safetensors",)
LICENSE = "MIT"
"""Licence of the weights; a card names the licences of the data that they were trained on."""


def registry(folder: Path = FOLDER) -> str:
    """The registry's text for a folder's files."""
    checkpoints = {
        path.stem: {"sha256": sha256_of(path), "bytes": path.stat().st_size, "license": LICENSE}
        for path in sorted(folder.glob("*.safetensors"))
    }
    return json.dumps({"urls": URLS, "checkpoints": checkpoints}, indent=1) + "\n"


if __name__ == "__main__":
    write_text(FOLDER / "registry.json", registry())
