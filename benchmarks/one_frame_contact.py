"""What one frame of a pose tells of a hand's contact: a network of 32 units on simulated sessions it has not seen.

The input is one hand's view of the suit's pose (`HandViews`, as in the contact network); training and test share no
person and no flat. value: average precision, the mean over trainings, to be at most `goal`: a posture is not a touch.
baseline: the share of frames in contact, which is the average precision of a guess. ratio = value / baseline.
"""

import argparse
import json
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.metrics.detection import average_precision
from wearcap.scene.objects import CONTACT_CLASSES
from wearcap.sensors.suit import suit_motion
from wearcap.simulation.handling.household import USUAL, Household
from wearcap.simulation.people.wearer import perform
from wearcap.simulation.places.interactive_flat import House
from wearcap.simulation.recordings.interaction_session import FLATS, InteractionConfig, flat_of
from wearcap.simulation.recordings.simulate import drawn_person, seeded
from wearcap.systems.ireplica.contact_sequence import ContactSequence
from wearcap.systems.ireplica.features import HandViews

ANY = "any"
SECONDS = 120.0
EVERY = 6
"""Step between the frames that are used: a tenth of a second."""
UNITS, EPOCHS, BATCH, RATE = 32, 12, 512, 3e-3
GOAL = 0.6
WINDOW, WINDOW_STEPS, WINDOW_BATCH = 180, 500, 24


def session(split: str, seed: int) -> tuple[Float[Tensor, "time feature"], Bool[Tensor, "time hand class"]]:
    """Features of the suit's poses, and true contact of both hands: any at all, and of each class."""
    config, rng = InteractionConfig(), seeded(7, split, seed)
    person, flat = drawn_person(split, rng), flat_of(split, seed % FLATS[split])
    household = Household(House(flat), person, rng, USUAL)
    household.live(SECONDS)
    simulated = perform(household.plan, flat.static, rng, SECONDS, config.fps)
    suit = suit_motion(simulated.motion, simulated.contact, config.suit, rng)
    held, times = household.house.interactions(SECONDS), suit.timestamps
    contact = torch.stack([held.hand_contact(times, name) for name in (None, *CONTACT_CLASSES)], -1)
    return HandViews().encode(suit.R_parent_joint), contact


Sessions = Sequence[tuple[Tensor, Tensor]]


def frames(sessions: Sessions) -> tuple[Float[Tensor, "sample feature"], Float[Tensor, "sample class"]]:
    """Each hand's view of single frames, with its contact."""
    views = [x[::EVERY].unflatten(-1, (2, -1)).flatten(0, 1) for x, _ in sessions]
    return torch.cat(views), torch.cat([y[::EVERY].flatten(0, 1) for _, y in sessions]).float()


def one_frame(train: Sessions, test: Sessions, seed: int) -> list[float]:
    """Average precision of any contact and of each class, of a network that sees one frame."""
    torch.manual_seed(seed)
    (x, y), (x_test, y_test) = frames(train), frames(test)
    mean, spread = x.mean(0), x.std(0).clamp_min(1e-3)
    network = nn.Sequential(nn.Linear(x.shape[1], UNITS), nn.ReLU(), nn.Linear(UNITS, y.shape[1]))
    steps = EPOCHS * (len(x) // BATCH)
    optimizer = torch.optim.AdamW(network.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    for _ in range(steps):
        rows = torch.randint(len(x), (BATCH,))
        loss = F.binary_cross_entropy_with_logits(network((x[rows] - mean) / spread), y[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        prob = network((x_test - mean) / spread).sigmoid()
    return [average_precision(prob[:, k], y_test[:, k] > 0.5) for k in range(y.shape[1])]


def whole_window(train: Sessions, test: Sessions, seed: int) -> list[float]:
    """The same of the contact network, which sees 61 frames; trained for minutes, not until it is best."""
    torch.manual_seed(seed)
    network = ContactSequence(train[0][0].shape[1], train[0][1].shape[2])
    network.normalize_on(torch.stack([x[: 60 * 60] for x, _ in train]))
    optimizer = torch.optim.AdamW(network.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=WINDOW_STEPS)
    margin = (WINDOW - network(torch.zeros(1, WINDOW, network.inputs)).shape[1]) // 2
    for _ in range(WINDOW_STEPS):
        chosen = [train[k] for k in torch.randint(len(train), (WINDOW_BATCH,)).tolist()]
        starts = [int(torch.randint(len(x) - WINDOW, ())) for x, _ in chosen]
        x = torch.stack([x[start : start + WINDOW] for (x, _), start in zip(chosen, starts)])
        y = torch.stack([y[start + margin : start + WINDOW - margin] for (_, y), start in zip(chosen, starts)])
        loss = F.binary_cross_entropy_with_logits(network(x), y.float())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    network.eval()
    with torch.no_grad():
        prob = torch.cat([network(x[None])[0].sigmoid() for x, _ in test]).flatten(0, 1)
    truth = torch.cat([y[margin : len(y) - margin] for _, y in test]).flatten(0, 1)
    return [average_precision(prob[:, k], truth[:, k]) for k in range(truth.shape[1])]


def figures(name: str, scores: Float[Tensor, "seed class"], test: Sessions) -> list[dict]:
    """One figure for any contact, and one for each class."""
    share = torch.cat([y.flatten(0, 1) for _, y in test]).float().mean(0).tolist()
    found = []
    for k, kind in enumerate((ANY, *CONTACT_CLASSES)):
        value = scores[:, k].mean().item()
        figure = {"name": f"{name} {kind}", "value": value, "unit": "AP", "baseline": share[k]}
        found.append({**figure, "ratio": value / share[k], "goal": GOAL})
    return found


def measure(train: int = 36, test: int = 16, seeds: int = 3, window: bool = False) -> list[dict]:
    sessions = [[session(split, k) for k in range(count)] for split, count in (("train", train), ("test", test))]
    found = figures(
        "one_frame_contact", torch.tensor([one_frame(*sessions, seed) for seed in range(seeds)]), sessions[1]
    )
    if window:
        found += figures("whole_window_contact", torch.tensor([whole_window(*sessions, 0)]), sessions[1])
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--window", action="store_true", help="the contact network's average precision as well (minutes)"
    )
    torch.set_num_threads(1)
    for each in measure(window=parser.parse_args().window):
        print(json.dumps(each))
