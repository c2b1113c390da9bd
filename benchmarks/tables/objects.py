"""The object encoder on generated objects it was not trained on (test seeds): what its feature tells.

Category by the network's own head: of objects as they are, turned about the vertical, and turned about any axis. Extents:
mean error of the half extents along the axes, as a share of the cloud's radius. Found again: the same object turned
about any axis, as nearest by the projected feature among all of the test. Beside it the nearest training object by
its half extents in metres, which knows the size, whereas the encoder does not. Speed: milliseconds per cloud of one core, one at a time.
"""

import argparse
import time
from pathlib import Path

import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor
from torch.nn import functional as F

from benchmarks.tables.tabling import new_table, write_tree
from wearcap.models.checkpoint import load_trained
from wearcap.models.point_encoder import bounds, to_unit_sphere
from wearcap.systems.echo.object_training import CloudAugmentation, ObjectEncoding
from wearsim.places.object_clouds import generate_clouds

VIEWS = {"as it is": None, "about the vertical": 0.0, "about any axis": 1.0}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--checkpoint", default="object_encoder", help="of experiment=object_encoder")
    parser.add_argument("--per-class", type=int, default=100, help="objects of each class")


def views(clouds: Tensor, turned: float | None) -> Tensor:
    """Clouds as they are, or turned, with jitter and lost points as in training, but not stretched."""
    if turned is None:
        return clouds
    vary = CloudAugmentation(stretch=0.0, turned=turned)
    return torch.stack([vary(cloud, torch.Generator().manual_seed(seed)) for seed, cloud in enumerate(clouds)])


def by_extents(classes: list[str], test: Tensor, labels: Tensor, per_class: int) -> float:
    """Accuracy of the nearest training object's category, by half extents (m)."""
    train, known = generate_clouds("train", classes, per_class)
    nearest = torch.cdist(bounds(test)[0], bounds(train)[0]).argmin(1)
    return (known[nearest] == labels).float().mean().item()


def milliseconds(system: ObjectEncoding, clouds: Float[Tensor, "batch point 3"]) -> float:
    system.net.encoder(clouds[:1])
    begin = time.thread_time()
    for cloud in clouds[:30]:
        system.net.encoder(cloud[None])
    return 1e3 * (time.thread_time() - begin) / len(clouds[:30])


def scored(system: ObjectEncoding, clouds: Tensor, labels: Tensor) -> tuple[dict[str, dict[str, float]], Tensor]:
    """Scores by view, and the confusion of views turned about any axis (rows: true)."""
    rows, projected, predicted = {}, {}, labels
    for name, turned in VIEWS.items():
        seen = views(clouds, turned)
        feature = torch.cat([system.net.encoder(part) for part in seen.split(64)])
        predicted = system.net.category(feature).argmax(-1)
        extents = bounds(seen)[0] / to_unit_sphere(seen)[1][:, None]
        projected[name] = F.normalize(system.net.instance(feature), dim=-1)
        again = (projected[name] @ projected["as it is"].T).argmax(1) == torch.arange(len(clouds))
        rows[name] = {
            "accuracy": (predicted == labels).float().mean().item(),
            "extents_error": (system.net.extents(feature) - extents).abs().mean().item(),
            "found_again": again.float().mean().item(),
        }
    count = len(system.net.classes)
    return rows, (labels * count + predicted).bincount(minlength=count**2).reshape(count, count)


@torch.inference_mode()
def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    torch.set_num_threads(1)
    system, _ = load_trained(options.checkpoint)
    assert isinstance(system, ObjectEncoding)
    classes, per_class = list(system.net.classes), 10 if options.quick else options.per_class
    clouds, labels = generate_clouds("test", classes, per_class)
    rows, confusion = scored(system, clouds, labels)
    table = new_table(
        f"{len(clouds)} objects of {len(classes)} classes", ["turned", "accuracy", "extents' error", "found again"]
    )
    for name, row in rows.items():
        table.add_row(name, *(f"{row[key]:.3f}" for key in ("accuracy", "extents_error", "found_again")))
    baseline = by_extents(classes, clouds, labels, per_class)
    table.add_row("nearest by extents (m)", f"{baseline:.3f}", "", "")
    confused = {
        f"{one} as {other}": int(confusion[i, j])
        for i, one in enumerate(classes)
        for j, other in enumerate(classes)
        if i != j and confusion[i, j]
    }
    speed = milliseconds(system, clouds)
    console = Console(width=120)
    console.print(table)
    console.print(f"turned about any axis, taken for others: {confused}\n{speed:.1f} ms per cloud")
    path = options.output / "objects.json"
    content = about | {
        "objects": len(clouds),
        "rows": rows,
        "by_extents": baseline,
        "confused": confused,
        "ms_per_cloud": speed,
    }
    return write_tree(path, content)
