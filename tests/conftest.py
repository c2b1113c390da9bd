"""Shape checks for the whole suite: jaxtyping annotations are enforced by beartype, in tests only."""

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

install_import_hook("wearcap", "shapes.checker")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; tests that need it carry the marker `real`."""
    root = Path(os.environ.get("WEARCAP_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.fail(f"{root} is not there: tests marked `real` need it (set WEARCAP_REAL_DATA)")
    return root
