"""What one frame of a pose tells of a hand's contact: a network of 32 units on simulated sessions it has not seen.

The input is one hand's view of the suit's pose (`HandViews`, as in the contact network); training and test share no
person and no flat. value: average precision, the mean over trainings, to be at most `goal`: a posture is not a touch.
baseline: the share of frames in contact, which is the average precision of a guess. ratio = value / baseline.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from benchmarks.speed.figures import figure
from wearcap.metrics.detection import average_precision
from wearcap.scene.objects import CONTACT_CLASSES
from wearcap.systems.ireplica.features import HandViews
from wearsim.handling.household import USUAL, Household
from wearsim.people.wearer import perform
from wearsim.places.interactive_flat import House
from wearsim.recordings.interaction_session import FLATS, InteractionConfig, flat_of
from wearsim.recordings.simulate import drawn_person, seeded
from wearsim.sensors.suit import suit_motion

ANY = "any"
SECONDS = 120.0
EVERY = 6
"""Step between the frames that are used: a tenth of a second."""
UNITS, EPOCHS, BATCH, RATE = 32, 12, 512, 3e-3
GOAL = 0.6


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


def measure(train: int = 36, test: int = 16, seeds: int = 3) -> list[dict]:
    seen, unseen = ([session(split, k) for k in range(count)] for split, count in (("train", train), ("test", test)))
    scores = torch.tensor([one_frame(seen, unseen, seed) for seed in range(seeds)]).mean(0).tolist()
    shares = torch.cat([y.flatten(0, 1) for _, y in unseen]).float().mean(0).tolist()
    return [
        figure(f"one_frame_contact {kind}", score, "AP", share, score / share, GOAL)
        for kind, score, share in zip((ANY, *CONTACT_CLASSES), scores, shares)
    ]
