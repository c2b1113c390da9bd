"""Grids of the points around the body: all frames in one call, against frame after frame over the whole cloud.

A flat of 108 m2 mapped with a million points; the grids agree. Baseline of the first figure: each frame turns all
points into its box, keeps those inside, and takes the least distance of every cell (NumPy). Of the second, which has
no goal: each frame asks a KD-tree, built once and not counted, for the point nearest to each cell's centre; it
cannot tell when points were seen. value and baseline: frames per second of one thread's own time, the cloud's sorting
counted for ours. ratio = value / baseline, to be at least `goal`.
"""

import math
import time

import numpy as np
import torch
from scipy.spatial import KDTree

from benchmarks.speed import planted_flat
from benchmarks.speed.figures import figure
from wearcap.geometry import rotation
from wearcap.scene.voxels import VoxelGrid, voxelize

GRID = VoxelGrid()


def brute_force(points: np.ndarray, place: np.ndarray, yaw: float) -> np.ndarray:
    """One frame's grid from all points of the cloud."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float32)
    box = (points - place + np.float32([0, 0, GRID.below_m])) @ turn
    box = (box[(np.abs(box) < 0.5 * GRID.size_m).all(1)] + 0.5 * GRID.size_m) / GRID.cell_m
    cell = box.astype(np.int64)
    distance = np.linalg.norm(box - cell - 0.5, axis=1) * GRID.cell_m
    grid = np.full((GRID.cells,) * 3, GRID.clip_m, np.float32)
    np.minimum.at(grid, tuple(cell.T), distance.astype(np.float32))
    return grid


def with_tree(tree: KDTree, place: np.ndarray, yaw: float) -> np.ndarray:
    """One frame's grid by asking for the nearest point to each cell's centre."""
    along = (np.arange(GRID.cells) + 0.5) * GRID.cell_m - 0.5 * GRID.size_m
    x, y, z = np.meshgrid(along, along, along, indexing="ij")
    cosine, sine = math.cos(yaw), math.sin(yaw)
    centers = np.stack([cosine * x - sine * y, sine * x + cosine * y, z - GRID.below_m], -1) + place
    return np.minimum(tree.query(centers, distance_upper_bound=GRID.clip_m)[0], GRID.clip_m)


def measure(points: int = 1_000_000, frames: int = 18_000, compared: int = 40) -> list[dict]:
    cloud, pose = planted_flat.flat(points), planted_flat.stroll(frames)
    voxelize(cloud[:100], pose[:2])
    begin = time.thread_time()
    grids = voxelize(cloud, pose)
    value = frames / (time.thread_time() - begin)
    tree, rows = KDTree(cloud.numpy()), cloud.numpy()
    chosen = torch.arange(compared) * (frames // compared)
    yaws, places = rotation.yaw_of(pose.R[chosen]).tolist(), pose.t[chosen].numpy()
    figures = []
    for unit, goal, method in (
        ("frames/s, all points per frame", 50.0, lambda place, yaw: brute_force(rows, place, yaw)),
        ("frames/s, KD-tree per frame", None, lambda place, yaw: with_tree(tree, place, yaw)),
    ):
        begin = time.thread_time()
        theirs = [method(place, yaw) for place, yaw in zip(places, yaws)]
        baseline = compared / (time.thread_time() - begin)
        error = float(np.abs(grids[chosen].numpy() - np.stack(theirs)).max())
        if error > 1e-3:
            raise SystemExit(f"error: the grids differ by {error} m ({unit})")
        figures.append(figure("voxelize_vs_brute_force", value, unit, baseline, value / baseline, goal))
    return figures
