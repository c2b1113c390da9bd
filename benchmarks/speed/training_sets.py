"""Generated data sets of any size: motions that are repeated, back and forth, with small changes of every joint."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.speed.planted import swinging
from wearcap.geometry import rotation
from wearcap.recording import ContactTrack, FloorTrack, HeadStream, Recording
from wearcap.recording.store import Entry, RecordingStore, save_recording

CHANGE_RAD = 0.05
"""Standard deviation of the slow changes of each joint's rotation, about each axis."""
AT_ONCE = 500
"""Recordings between two writings of the manifest."""


def varied(recording: Recording, name: str, seconds: float, fps: float, seed: int) -> Recording:
    """A motion of so many seconds from a shorter or longer one, with its head and contacts; a function of the seed."""
    random, motion = torch.Generator().manual_seed(seed), recording.motion
    assert motion is not None
    count, every = round(seconds * fps), max(1, round(motion.fps / fps))
    there = torch.arange(0, len(motion), every)
    lap = torch.cat([there, there.flip(0)])
    start = int(torch.randint(len(lap), (), generator=random))
    frames = lap[(start + torch.arange(count)) % len(lap)]
    t = torch.arange(count, dtype=torch.float64) / fps
    joints = len(motion.skeleton)
    frequency, phase = torch.rand(2, joints, 3, generator=random)
    size = CHANGE_RAD * torch.randn(joints, 3, generator=random)
    wave = size * torch.sin(2 * torch.pi * ((0.1 + frequency) * t.float()[:, None, None] + phase))
    R = motion.R_parent_joint[frames] @ rotation.exp(wave)
    moved = replace(motion, timestamps=t, R_parent_joint=R, t_world_root=motion.t_world_root[frames], contact_prob=None)
    T, contacts = moved.joint("head"), recording.contacts
    return Recording(
        name,
        head=HeadStream(t, T.R.contiguous(), T.t.contiguous(), torch.eye(3), torch.zeros(3)),
        motion=moved,
        contacts=contacts and ContactTrack(t, contacts.parts, contacts.contact[frames]),
        floor=FloorTrack(t, torch.zeros(count)),
        skeleton=motion.skeleton,
        subject=f"{seed % 100}",
    )


def generated(sources: Sequence[Recording], hours: float, seconds: float, fps: float) -> Iterator[Recording]:
    """Recordings of so many seconds, hours in all."""
    for number in range(max(2, round(3600 * hours / seconds))):
        yield varied(sources[number % len(sources)], f"{number:06d}", seconds, fps, number)


def write_set(folder: Path, recordings: Iterator[Recording]) -> int:
    """Write a data set recording by recording, every hundredth (and the second) for validation; returns its bytes."""
    store, entries, written = RecordingStore(folder), {}, 0
    for number, recording in enumerate(recordings):
        save_recording(recording, store.path_of(recording.name))
        split = "val" if number % 100 == 1 else "train"
        entries[recording.name] = Entry.of(recording, folder, split, "generated")
        written += entries[recording.name].bytes
        if len(entries) == AT_ONCE:
            store.register(entries)
            entries = {}
    store.register(entries)
    return written


def sources_of(folder: Path | None, count: int = 40) -> list[Recording]:
    """Training recordings with a motion, of a data set of recorded people or else of bodies that swing their joints."""
    if folder is None:
        return [swinging(f"{seed}", 10.0, seed) for seed in range(3)]
    store = RecordingStore.open(folder)
    names = [name for name in store.names("train") if store.entries[name].duration_s > 5]
    return [store.load(name) for name in names[:: max(1, len(names) // count)][:count]]
