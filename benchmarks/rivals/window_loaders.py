"""Loaders of training windows as other papers' code has them, of the same recordings: per window in Python, with processes.

What they load is what a step of `experiment=motion_diffusion_head` begins with: features of the head's path and rotations of
the joints. These are computed beforehand and written to files; windows are neither varied nor noisy, which spares these
loaders most of what ours does.

`FilePerItem` opens a clip's whole file for every window (AvatarPoser, BoDiffusion); `ClipsInMemory` reads all files at the
start (AGRoL, whose clips are drawn alike, however long they are); `Archive` has all clips of a split in one file, keeps in
each process what it has read, and draws as many windows as cover the frames once (EgoAllo, whose file is HDF5; a .npz here).
"""

from collections.abc import Sequence
from pathlib import Path
from random import randrange
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from wearcap.data.features import body_size, true_foot_contact
from wearcap.geometry.rotation import quat_wxyz_from_matrix
from wearcap.recording.store import RecordingStore
from wearcap.systems.hmd2.features import HeadFeatures

Clip = dict[str, np.ndarray]


class Encoded(NamedTuple):
    """Encoded windows, with a leading batch axis."""

    condition: Float[Tensor, "*batch time condition"]
    motion: Float[Tensor, "*batch time motion"]


def encoded_clips(stores: Sequence[RecordingStore], features: HeadFeatures, window: int) -> dict[str, Clip]:
    """ "condition" and "motion" of all training recordings that are longer than a window, by name."""
    clips = {}
    for number, store in enumerate(stores):
        for name in store.names("train"):
            if store.entries[name].frames <= window:
                continue
            recording = store.load(name)
            head, motion = recording.head, recording.motion
            assert head is not None
            assert motion is not None
            T, size = head.T_world_head, body_size(motion.skeleton)[None]
            contact = true_foot_contact(recording).float()[None]
            floor = torch.zeros(1, len(motion)) if recording.floor is None else recording.floor.height[None].float()
            clips[f"{number}_{name}"] = {
                "condition": features.condition(T.R[None], T.t[None], floor, size, motion.fps)[0].numpy(),
                "motion": features.encode(motion.R_parent_joint[None], T.R[None], contact)[0].numpy(),
            }
    return clips


def raw_clips(stores: Sequence[RecordingStore], window: int) -> dict[str, Clip]:
    """Poses of head and joints as EgoAllo's files have them, quaternions and positions, by name."""
    clips = {}
    for number, store in enumerate(stores):
        for name in store.names("train"):
            if store.entries[name].frames < window:
                continue
            recording = store.load(name)
            head, motion = recording.head, recording.motion
            assert head is not None
            assert motion is not None
            T, step = head.T_world_head, head.T_world_head.inverse()
            relative = step[:-1] @ T[1:]
            first = slice(0, 1)
            clips[f"{number}_{name}"] = {
                "T_world_root": _pose(motion.R_parent_joint[:, 0], motion.t_world_root),
                "contacts": true_foot_contact(recording).float().numpy(),
                "betas": body_size(motion.skeleton)[None].numpy(),
                "body_quats": quat_wxyz_from_matrix(motion.R_parent_joint[:, 1:]).numpy(),
                "T_cpf_tm1_cpf_t": _pose(*(torch.cat([part[first], part]) for part in (relative.R, relative.t))),
                "height_from_ground": T.t[:, 2:].numpy(),
                "T_world_cpf": _pose(T.R, T.t),
            }
    return clips


def _pose(R: Float[Tensor, "time 3 3"], t: Float[Tensor, "time 3"]) -> np.ndarray:
    return torch.cat([quat_wxyz_from_matrix(R), t], -1).numpy()


class FilePerItem(Dataset):
    """A random window of the clip that an item's file holds."""

    def __init__(self, clips: dict[str, Clip], folder: Path, window: int):
        """The clips are written to the folder."""
        self.window, self.paths = window, [folder / f"{name}.npz" for name in clips]
        for path, clip in zip(self.paths, clips.values()):
            np.savez(path, **clip)  # pyright: ignore[reportArgumentType]

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, item: int) -> Encoded:
        with np.load(self.paths[item]) as file:
            clip = {name: file[name] for name in file.files}
        start = randrange(len(clip["motion"]) - self.window)
        return Encoded(*(torch.from_numpy(part[start : start + self.window]) for part in clip.values()))


class ClipsInMemory(Dataset):
    """A random window of a clip, its motion normalised; a pass takes each clip `REPEATS` times."""

    REPEATS = 1000

    def __init__(self, clips: dict[str, Clip], window: int):
        self.window = window
        self.clips = [Encoded(*(torch.from_numpy(part) for part in clip.values())) for clip in clips.values()]
        rows = torch.cat([clip.motion for clip in self.clips])
        self.mean, self.std = rows.mean(0), rows.std(0)

    def __len__(self) -> int:
        return self.REPEATS * len(self.clips)

    def __getitem__(self, item: int) -> Encoded:
        condition, motion = self.clips[item % len(self.clips)]
        start = int(torch.randint(0, len(motion) - self.window, (1,)))
        frames = slice(start, start + self.window)
        return Encoded(condition[frames].float(), ((motion[frames] - self.mean) / (self.std + 1e-8)).float())


class Archive(Dataset):
    """A random window of a clip in the one file of a split; fields as they are, to be encoded in the step."""

    def __init__(self, clips: dict[str, Clip], path: Path, window: int):
        """The clips are written to the path."""
        self.path, self.window, self.names = path, window, [*clips]
        self._kept: dict[str, Clip] = {}
        self._count = sum(len(clip["T_world_root"]) for clip in clips.values()) // window
        self.fields = [*next(iter(clips.values()))]
        np.savez(path, **{f"{name}/{field}": part for name, clip in clips.items() for field, part in clip.items()})  # pyright: ignore[reportArgumentType]

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, item: int) -> dict[str, Tensor]:
        name = self.names[item % len(self.names)]
        if name not in self._kept:
            with np.load(self.path) as file:
                self._kept[name] = {field: file[f"{name}/{field}"] for field in self.fields}
        clip = self._kept[name]
        start = randrange(len(clip["T_world_root"]) - self.window + 1)
        parts = {field: part if field == "betas" else part[start : start + self.window] for field, part in clip.items()}
        found = {field: torch.from_numpy(part) for field, part in parts.items()}
        return found | {"mask": torch.ones(self.window, dtype=torch.bool)}


def loader(dataset: Dataset, batch_size: int, workers: int) -> DataLoader:
    """The papers' loader: shuffled whole batches from processes, which stay."""
    return DataLoader(
        dataset, batch_size, shuffle=True, num_workers=workers, drop_last=True, persistent_workers=workers > 0
    )
