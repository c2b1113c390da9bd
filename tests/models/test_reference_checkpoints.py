"""The checkpoints that come with the repository: whole, small, described, and nothing of the machine that trained them."""

import re
from pathlib import Path

import pytest
import torch

from wearcap.body.skeleton import xsens23
from wearcap.models.checkpoint import read_checkpoint, share_checkpoint, shared_checkpoints
from wearcap.recording import Motion
from wearcap.systems.ireplica.contact_prediction import ContactPredictor

FOLDER = Path(__file__).parents[2] / "checkpoints"
CONTACTS = {
    "contact_sequence": ("sliding", "hinged"),
    "contact_transformer_sliding": ("sliding",),
    "contact_transformer_hinged": ("hinged",),
}
CARD = ("**What it is.**", "**Data and licences.**", "**Figures.**", "**How to make it.**")
MAX_BYTES = 50_000_000


def test_a_checkpoint_and_its_card_come_together():
    assert set(CONTACTS) <= set(shared_checkpoints())
    assert {path.stem for path in FOLDER.glob("*.md")} == set(shared_checkpoints())
    assert {path.suffix for path in FOLDER.iterdir()} == {".json", ".md", ".safetensors"}


@pytest.mark.parametrize("name", shared_checkpoints())
def test_a_card_states_what_when_and_how(name):
    card = (FOLDER / f"{name}.md").read_text(encoding="utf-8")
    assert card.startswith(f"# {name}\n")
    places = [card.find(heading) for heading in CARD]
    assert -1 < places[0] < places[1] < places[2] < places[3], "what, data, figures, how"
    assert re.search(r"\b20\d\d-\d\d-\d\d\b", card[places[2] :]), "a date of the figures"
    assert re.search(r"`python \w+.*\.py", card[places[2] : places[3]]), "the figures' command"
    assert f"format=safetensors output=checkpoints/{name}.safetensors" in card[places[3] :]


@pytest.mark.parametrize("name", shared_checkpoints())
def test_what_is_shared_is_weights_and_the_models_config(name, tmp_path):
    assert (FOLDER / f"{name}.safetensors").stat().st_size < MAX_BYTES
    config, state = read_checkpoint(name)
    assert set(config) <= {"name", "model", "data", "training"}
    assert not re.search(r"'/|\.\./", str(config)), "a folder of the machine"
    assert all(value.isfinite().all() for value in state.values())
    share_checkpoint(name, tmp_path / "again.safetensors")
    again, same = read_checkpoint(tmp_path / "again.safetensors")
    assert again == config
    assert all(torch.equal(same[key], value) for key, value in state.items())


@pytest.mark.parametrize("name", CONTACTS)
def test_a_contact_network_tells_contacts_of_its_classes(name):
    assert (FOLDER / f"{name}.safetensors").stat().st_size < 200_000
    skeleton, times = xsens23(), torch.arange(90, dtype=torch.float64) / 60
    still = Motion(times, skeleton, torch.eye(3).repeat(90, len(skeleton), 1, 1), torch.zeros(90, 3))
    prob = ContactPredictor.load(name)(still)
    assert tuple(prob) == CONTACTS[name]
    assert all(value.shape == (90, 2) and (value < 0.5).all() for value in prob.values())
