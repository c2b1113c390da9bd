"""Shape checks for the whole suite: jaxtyping annotations are enforced by beartype, in tests only.

WEARCAP_EXAMPLES=1000 makes the property tests and the fuzzing of the readers search longer.
"""

import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

install_import_hook("wearcap", "shapes.checker")

# What tests remember of files (checksums) is not the user's; it goes with the system's temporary files.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="wearcap-tests-")

settings.register_profile("suite", max_examples=int(os.environ.get("WEARCAP_EXAMPLES", "25")), deadline=None)
settings.load_profile("suite")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; tests that need it carry the marker `real`."""
    root = Path(os.environ.get("WEARCAP_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.fail(f"{root} is not there: tests marked `real` need it (set WEARCAP_REAL_DATA)")
    return root
