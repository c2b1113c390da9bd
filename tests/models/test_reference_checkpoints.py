"""The checkpoints that come with the repository: whole, small, and nothing of the machine that trained them."""

from pathlib import Path

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.models.checkpoint import read_checkpoint, share_checkpoint
from wearcap.pipelines.contact_prediction import ContactPredictor
from wearcap.recording import Motion

FOLDER = Path(__file__).parents[2] / "checkpoints"
CLASSES = {
    "contact_sequence": ("sliding", "hinged"), "contact_transformer_sliding": ("sliding",),
    "contact_transformer_hinged": ("hinged",),
}  # fmt: skip


@pytest.mark.parametrize("name", CLASSES)
def test_a_reference_network_tells_contacts_of_its_classes(name):
    path = FOLDER / f"{name}.ckpt"
    assert path.stat().st_size < 200_000
    skeleton, times = xsens23(), torch.arange(90, dtype=torch.float64) / 60
    still = Motion(times, skeleton, torch.eye(3).repeat(90, len(skeleton), 1, 1), torch.zeros(90, 3))
    prob = ContactPredictor.load(path)(still)
    assert tuple(prob) == CLASSES[name]
    assert all(value.shape == (90, 2) and (value < 0.5).all() for value in prob.values())


@pytest.mark.parametrize("name", CLASSES)
def test_what_is_shared_is_weights_and_the_models_config(name, tmp_path):
    config, state = read_checkpoint(FOLDER / f"{name}.ckpt")
    assert set(config) == {"name", "model"}
    assert "/" not in str(config)
    share_checkpoint(FOLDER / f"{name}.ckpt", tmp_path / "again.ckpt")
    again, same = read_checkpoint(tmp_path / "again.ckpt")
    assert again == config
    assert all(torch.equal(same[key], value) for key, value in state.items())
