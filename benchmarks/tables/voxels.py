"""The code of the points around the body: how well grids come back from it (test split), beside baselines.

Baselines: the most similar grid of the training split, 128 principal components of it, and always saying "no point".
Distances are compared over all cells, and over those that hold a point (2 % of them in simulated data, so that
saying nothing is hard to beat over all cells). For methods that tell distances and never "no point" (principal components,
the paper's squared error), the distance below which a cell counts as held is the one best on validation data.
Speed: grids per second of one core. Writes a picture of slices, too.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor

from benchmarks.tables.tabling import new_table, write_tree
from wearcap.apps.viewer.picture import save_png
from wearcap.data.surroundings import PlaceCodes
from wearcap.data.windows import Source, Windows
from wearcap.metrics.detection import distance_mae_cm, occupancy_iou, occupied_distance_mae_cm
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.scene.voxels import VoxelGrid
from wearcap.systems.hmd2.voxel_autoencoder_training import PlaceContent

Rebuild = Callable[[Tensor], Tensor]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, default=Path("datasets/simulated_camera"), help="prepared data set")
    parser.add_argument(
        "--checkpoints",
        nargs="*",
        default=["ours=voxel_autoencoder"],
        metavar="[LABEL=]PATH",
        help="voxel autoencoders to compare",
    )


def grids_of(root: Path, split: str, count: int, grid: VoxelGrid) -> Tensor:
    """Grids (m) spread evenly over a split's windows of 4 s."""
    dataset = Windows([Source(str(root))], split, content=PlaceContent(grid), window=8, stride=8, fps=2.0, every=None)
    chosen = torch.linspace(0, len(dataset) - 1, max(1, count // 8)).long()
    return dataset.batch(chosen, chosen).grids.flatten(0, 1)


def principal(train: Tensor, size: int = 128) -> Rebuild:
    rows = train.flatten(1)
    mean = rows.mean(0)
    axes = torch.linalg.eigh((rows - mean).T @ (rows - mean))[1][:, -size:]
    return lambda grids: ((grids.flatten(1) - mean) @ axes @ axes.T + mean).reshape(grids.shape)


def nearest(train: Tensor) -> Rebuild:
    rows = train.flatten(1)
    length = rows.square().sum(1)

    def rebuild(grids: Tensor) -> Tensor:
        parts = [(length - 2 * part.flatten(1) @ rows.T).argmin(1) for part in grids.split(500)]
        return train[torch.cat(parts)]

    return rebuild


def best_border(rebuild: Rebuild, val: Tensor, clip_m: float) -> float:
    """Distance (m) below which a rebuilt cell counts as held."""
    rebuilt, borders = rebuild(val), torch.linspace(0.3, 0.999, 36) * clip_m
    return max(borders.tolist(), key=lambda border: occupancy_iou(rebuilt, val, clip_m, border).item())


def scored(rebuild: Rebuild, val: Tensor, test: Tensor, clip_m: float) -> dict[str, float]:
    border = best_border(rebuild, val, clip_m)
    rebuilt = rebuild(test).clamp(0, clip_m)
    return {
        "distance_cm": distance_mae_cm(rebuilt, test).item(),
        "held_distance_cm": occupied_distance_mae_cm(rebuilt, test, clip_m).item(),
        "occupancy_iou": occupancy_iou(rebuilt, test, clip_m, border).item(),
    }


def encoded_per_second(encode: Rebuild, grids: Tensor, batch: int = 256) -> float:
    encode(grids[:batch])
    begin = time.thread_time()
    for part in grids.split(batch):
        encode(part)
    return len(grids) / (time.thread_time() - begin)


def slices(grids: dict[str, Tensor], clip_m: float, level: int = 5, pixels: int = 8) -> Tensor:
    """A picture of each grid (columns) by each method (rows): the nearest point of each column of cells seen from above
    (ahead is up), and above that the upright slice through the middle; nearer points are brighter."""
    rows = []
    for given in grids.values():
        shades = [
            ((1 - view / clip_m).clamp(0, 1) * 255)
            for view in (given[:, :, level].transpose(1, 2).flip(1), given.amin(3).flip(1, 2))
        ]
        tiles = torch.cat([torch.nn.functional.pad(shade, (0, 1, 0, 1), value=90.0) for shade in shades], 1)
        rows.append(torch.cat(list(tiles), 1))
    return torch.cat(rows).repeat_interleave(pixels, 0).repeat_interleave(pixels, 1)


def methods(options: argparse.Namespace, train: Tensor) -> tuple[dict[str, Rebuild], dict[str, VoxelAutoencoder]]:
    """Ways to rebuild grids by label, and the networks among them."""
    rebuilds: dict[str, Rebuild] = {
        "no point anywhere": lambda grids: torch.full_like(grids, VoxelGrid().clip_m),
        "nearest of training": nearest(train),
        "128 principal components": principal(train),
    }
    networks = {}
    for given in options.checkpoints:
        label, _, path = given.rpartition("=")
        net = PlaceCodes(path).encoder
        networks[label or "ours"] = net
        rebuilds[label or "ours"] = lambda grids, net=net: torch.cat(
            [net.decode(net.encode(part)) for part in grids.split(500)]
        )
    return rebuilds, networks


@torch.no_grad()
def tables(options: argparse.Namespace, about: dict[str, str]) -> Path:
    torch.set_num_threads(1)
    grid, share = VoxelGrid(), 8 if options.quick else 1
    train, val, test = (
        grids_of(options.data, split, count // share, grid)
        for split, count in (("train", 24_000), ("val", 1_000), ("test", 4_000))
    )
    rebuilds, networks = methods(options, train)
    rows = {label: scored(rebuild, val, test, grid.clip_m) for label, rebuild in rebuilds.items()}
    for label, net in networks.items():
        rows[label]["encoded_per_s"] = encoded_per_second(net.encode, test)
        rows[label]["parameters"] = sum(weights.numel() for weights in net.parameters())
    table = new_table(
        f"Grids of {options.data.name} from their codes ({len(test)} of the test split)",
        ["", "distance, cm", "of held cells, cm", "occupancy IoU", "encoded/s", "parameters"],
    )
    for label, row in rows.items():
        figures = [f"{row['distance_cm']:.4f}", f"{row['held_distance_cm']:.2f}", f"{row['occupancy_iou']:.3f}"]
        figures += [f"{row[name]:,.0f}" for name in ("encoded_per_s", "parameters") if name in row]
        table.add_row(label, *figures)
    Console(width=120).print(table)
    shown = test[:: len(test) // 12][:12]
    pictured = {"true": shown} | {label: rebuild(shown) for label, rebuild in rebuilds.items()}
    picture = slices(pictured, grid.clip_m).byte()[..., None].expand(-1, -1, 3)
    save_png(options.output / "voxels_slices.png", picture.numpy())
    path = options.output / "voxels.json"
    content = about | {"test_grids": len(test), "picture_rows": list(pictured), "rows": rows}
    return write_tree(path, content)
