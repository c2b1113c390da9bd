"""A small network that tells simulated from recorded people by the paths of head and wrists."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from benchmarks.tables.gait_statistics import FPS, Clip, is_walking, windows_of
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.systems.hmd2.features import HeadFeatures

BATCH = 64


def paths(clip: Clip, walking: bool) -> Float[Tensor, "window frame channel"]:
    """Head features and wrists in the head's heading frame, lengths as shares of stature; 2 s at 30 Hz."""
    chosen = is_walking(clip) if walking else slice(None)
    R_head = windows_of(clip.R_world_head)[chosen]
    t_head = windows_of(clip.joints["head"])[chosen]
    floor = windows_of(clip.floor)[chosen]
    stature = torch.full((len(t_head), 1), clip.stature)
    head = HeadFeatures().condition(R_head, t_head, floor, stature, float(FPS))
    R_heading_world = rotation.about_axis("z", -rotation.yaw_of(R_head))
    channels = [head]
    for wrist in ("left_wrist", "right_wrist"):
        offset = windows_of(clip.joints[wrist])[chosen] - t_head
        local = (R_heading_world @ offset[..., None])[..., 0] / clip.stature
        step = local.diff(dim=1, prepend=local[:, :1]) * FPS
        channels += [local, step]
    return torch.cat(channels, -1)


class Discriminator(nn.Module):
    """Two strided convolutions over time, their mean, one logit."""

    def __init__(self, channels: int, width: int = 32):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv1d(channels, width, 5, stride=2),
            nn.ReLU(),
            nn.Dropout(0.2),
            nn.Conv1d(width, width, 5, stride=2),
            nn.ReLU(),
            nn.AdaptiveAvgPool1d(1),
            nn.Flatten(),
            nn.Linear(width, 1),
        )

    def forward(self, x: Float[Tensor, "window frame channel"]) -> Float[Tensor, "window"]:
        return self.layers(x.transpose(1, 2))[:, 0]


def held_out_accuracy(
    simulated: list[Clip], recorded: list[Clip], walking: bool, seeds: range, steps: int
) -> dict[str, float | int | list[float]]:
    """Balanced accuracy on people that the network has not seen, over seeds of split, weights and batches."""
    sides = [_by_person(clips, walking) for clips in (simulated, recorded)]
    if min(len(side) for side in sides) < 2:
        counts = " and ".join(str(len(side)) for side in sides)
        raise WearcapError(
            f"{counts} people with {'walking ' if walking else ''}windows of 2 s",
            expected="two on each side at least, one of whom is held out",
        )
    results = [_one_training(sides, seed, steps) for seed in seeds]
    accuracies = torch.tensor([accuracy for accuracy, _ in results])
    spread = accuracies.std().item() if len(accuracies) > 1 else 0.0
    return {
        "mean": accuracies.mean().item(),
        "std": spread,
        "accuracies": accuracies.tolist(),
        "people": sum(len(side) for side in sides),
        "held_out_windows": results[0][1],
    }


def _by_person(clips: list[Clip], walking: bool) -> dict[str, Tensor]:
    """All windows of each person; people without any are left out."""
    found: dict[str, list[Tensor]] = {}
    for clip in clips:
        windows = paths(clip, walking)
        if len(windows):
            found.setdefault(clip.person, []).append(windows)
    return {person: torch.cat(windows) for person, windows in found.items()}


def _one_training(sides: list[dict[str, Tensor]], seed: int, steps: int) -> tuple[float, int]:
    """Train on two thirds of the people of each side; (balanced accuracy on the others, number of windows)."""
    random = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    train, test = [], []
    for side in sides:
        order = [sorted(side)[i] for i in torch.randperm(len(side), generator=random).tolist()]
        held = max(1, len(order) // 3)
        test.append(torch.cat([side[person] for person in order[:held]]))
        train.append([side[person] for person in order[held:]])
    everything = torch.cat([torch.cat(people) for people in train]).flatten(0, 1)
    mean, scale = everything.mean(0), everything.std(0).clamp_min(1e-3)
    network = Discriminator(len(mean))
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=0.01)
    label = torch.cat([torch.zeros(BATCH // 2), torch.ones(BATCH // 2)])
    for _ in range(steps):
        batch = torch.cat([_draw(people, BATCH // 2, random) for people in train])
        loss = nn.functional.binary_cross_entropy_with_logits(network((batch - mean) / scale), label)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    network.eval()
    with torch.inference_mode():
        right = [
            ((network((windows - mean) / scale) > 0) == bool(side)).float().mean().item()
            for side, windows in enumerate(test)
        ]
    return sum(right) / 2, sum(len(windows) for windows in test)


def _draw(people: list[Tensor], count: int, random: torch.Generator) -> Float[Tensor, "window frame channel"]:
    """Windows drawn so that every person counts alike: CMU's people have very different shares of its minutes."""
    rows = []
    for person in torch.randint(len(people), (count,), generator=random).tolist():
        windows = people[person]
        rows.append(windows[int(torch.randint(len(windows), (1,), generator=random))])
    return torch.stack(rows)
