"""Packets that no device should send: values of every wrong kind, and mutations of good ones by a seeded generator."""

import inspect
import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import torch

from wearcap.geometry.rigid import Rigid
from wearcap.recording import Motion

TIMES = {
    "nan": math.nan,
    "infinite": math.inf,
    "absurd": 1e18,
    "milliseconds": 1.7e12,
    "far": 1e9,
    "ahead": 100.0,
    "none": None,
    "text": "now",
    "huge": 10**400,
    "complex": 1j,
}
VECTORS = {
    "nan": torch.tensor([0.0, math.nan, 0.0]),
    "infinite": torch.tensor([0.0, 0.0, -math.inf]),
    "large": torch.tensor([1e30, 0.0, 0.0]),
    "short": torch.zeros(2),
    "integer": torch.zeros(3, dtype=torch.int64),
    "complex": torch.zeros(3, dtype=torch.complex64),
    "numpy": np.zeros(3),
    "none": None,
    "list": [0.0, 0.0, 0.0],
    "sparse": torch.zeros(3).to_sparse(),
    "meta": torch.zeros(3, device="meta"),
}
ROTATIONS = {
    "nan": torch.full((3, 3), math.nan),
    "flat": torch.eye(3, 4),
    "scaled": 2 * torch.eye(3),
    "mirror": torch.diag(torch.tensor([1.0, 1.0, -1.0])),
    "zero": torch.zeros(3, 3),
    "integer": torch.eye(3, dtype=torch.int64),
    "numpy": np.eye(3),
    "none": None,
    "batch": torch.eye(3)[None],
}


def unchecked(call: Callable) -> Callable:
    """A function without the suite's checks of its arguments: as whoever uses the package has it."""
    inner = inspect.unwrap(call)
    return inner if not inspect.ismethod(call) else inner.__get__(call.__self__)


def broken(value: Any, **parts: Any) -> Any:
    """A copy of a dataclass with other parts, whatever they are."""
    copy = object.__new__(type(value))
    for name in (field.name for field in fields(value)):
        object.__setattr__(copy, name, parts.get(name, getattr(value, name)))
    return copy


def given(session: Any, ended: bool = False) -> list[Motion]:
    """What a session hands out at one call: one motion or none."""
    motion = session.poses(ended=ended)
    return [] if motion is None else [motion]


def bad_poses(good: Rigid) -> dict[str, Any]:
    poses = {f"R {name}": broken(good, R=R) for name, R in ROTATIONS.items()}
    poses |= {f"t {name}": broken(good, t=t) for name, t in VECTORS.items()}
    return poses | {"matrix": torch.eye(4), "tuple": (good.R, good.t), "text": "here"}


class Mutator:
    """Draws good values and bad ones, over and over the same for one seed."""

    def __init__(self, seed: int, share: float = 0.3):
        self.random, self.share = np.random.default_rng(seed), share

    def bad(self) -> bool:
        return bool(self.random.random() < self.share)

    def one(self, values: dict[str, Any]) -> Any:
        return list(values.values())[self.random.integers(len(values))]

    def time(self, good: float) -> Any:
        if not self.bad():
            return good
        off = self.random.normal(scale=self.random.choice([0.01, 1.0, 1000.0]))
        return self.one(TIMES | {"off": good + float(off), "again": good - 1 / 30})

    def pose(self, good: Rigid) -> Any:
        lost, elsewhere = None, Rigid(good.R, good.t + float(self.random.normal(scale=5000.0)))
        return self.one(bad_poses(good) | {"lost": lost, "away": elsewhere}) if self.bad() else good
