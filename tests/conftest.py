"""Shape checks for the whole suite: jaxtyping annotations are enforced by beartype, in tests only.

WEARCAP_EXAMPLES=1000 makes the property tests and the fuzzing of the readers search longer.
"""

import gc
import os
import tempfile
from functools import partialmethod
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

gc.disable()  # until all is imported, which leaves little to collect
install_import_hook(["wearcap", "wearsim", "data_prep"], "shapes.checker")

# What tests remember of files (checksums) is not the user's; it goes with the system's temporary files.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="wearcap-tests-")
# All processes of a run share it.
os.environ.setdefault("WEARCAP_CACHE", os.path.join(os.environ["XDG_CACHE_HOME"], "shared"))

settings.register_profile("suite", max_examples=int(os.environ.get("WEARCAP_EXAMPLES", "25")), deadline=None)
settings.load_profile("suite")


def pytest_collection_finish() -> None:
    """What was imported stays: collections need not look at it again."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; tests that need it carry the marker `real`."""
    root = Path(os.environ.get("WEARCAP_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.fail(f"{root} is not there: tests marked `real` need it (set WEARCAP_REAL_DATA)")
    return root


@pytest.fixture
def trusted(monkeypatch):
    """Files of formats that can run code open wherever a test writes them, as with `trust=true`."""
    monkeypatch.setenv("WEARCAP_TRUST", "1")


@pytest.fixture(scope="module")
def few_statistics():
    """Training takes its normalisation from 100 windows in place of up to 1500, which would take most of a short run."""
    from benchmarks.rivals.pose_regression.training import PoseRegression
    from wearcap.systems.echo.training import EchoDiffusion
    from wearcap.systems.hmd2.training import MotionDiffusion
    from wearcap.systems.hmd2.voxel_autoencoder_training import VoxelReconstruction
    from wearcap.systems.ireplica.training import ContactDetection
    from wearcap.systems.mocap_every.manifold_training import ManifoldTraining
    from wearcap.systems.mocap_every.training import WatchRegression
    from wearcap.training.motion_autoencoder import MotionEncoding

    systems = (
        ContactDetection,
        EchoDiffusion,
        ManifoldTraining,
        MotionDiffusion,
        MotionEncoding,
        PoseRegression,
        VoxelReconstruction,
        WatchRegression,
    )
    with pytest.MonkeyPatch.context() as patch:
        for system in systems:
            patch.setattr(system, "set_statistics", partialmethod(system.set_statistics, limit=100))
        yield
