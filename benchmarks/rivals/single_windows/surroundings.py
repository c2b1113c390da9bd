"""Conditions of a window beside the head's path: codes of the points around the body, and image embeddings."""

import hashlib
from collections.abc import Sequence
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int64
from rich.progress import track
from torch import Tensor

from benchmarks.rivals.single_windows.windows import open_recording
from wearcap.boundary.tensors import open_tensors, write_tensors
from wearcap.data.surroundings import embeddings_of, latest_before
from wearcap.models.checkpoint import load_network
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording.store import Entry, RecordingStore
from wearcap.scene.voxels import VoxelMap, mirrored

MAX_PICTURE_AGE_S = 0.2
"""Largest age (s) at which an image still conditions a frame."""
_AT_ONCE = 2048
"""Grids that are encoded at a time."""


Features = tuple[Float[Tensor, "time feature"], Bool[Tensor, "time"]]
"""Features of a condition, and which frames have them; elsewhere they are any finite numbers."""


class ConditionWindows:
    """A condition in training windows: its features at the frames of a recording's head stream."""

    metric: ClassVar[bool] = False
    """Whether features depend on lengths, so that windows cannot be scaled."""
    size: int
    """Number of features of a frame, known after `prepare`."""
    encoder: Any = None
    """The network that made them, or its name; None: none did."""

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        """Make or check what reading the recordings of a split needs."""

    def read(self, store: RecordingStore, name: str, start: int, stop: int, mirrored: bool) -> Features:
        """Features of frames start…stop-1; `mirrored`: of everything mirrored left to right."""
        raise NotImplementedError


class PlaceCodes(ConditionWindows):
    """Codes of the points around the body by a trained voxel autoencoder (thesis §6.2)."""

    metric = True

    def __init__(self, checkpoint: str | Path):
        """`checkpoint`: path or name of a checkpoint of experiment=voxel_autoencoder."""
        self.checkpoint = checkpoint

    @cached_property
    def encoder(self) -> VoxelAutoencoder:
        """The network, in evaluation mode. Raises WearcapError when the checkpoint is missing or another network's."""
        return load_network(self.checkpoint, VoxelAutoencoder, "voxel_autoencoder").requires_grad_(False)

    @property
    def size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.encoder.size

    @cached_property
    def fingerprint(self) -> str:
        """16 hex digits that depend on the weights and the grid."""
        digest = hashlib.sha256(repr(self.encoder.grid).encode())
        for name, value in sorted(self.encoder.state_dict().items()):
            digest.update(name.encode() + value.contiguous().numpy().tobytes())
        return digest.hexdigest()[:16]

    def file_of(self, root: Path, entry: Entry) -> Path:
        """File of a recording's codes, made if it is missing.

        It contains `code` and, for the surroundings mirrored left to right, `code_mirrored` ("time feature", float16)
        at the head stream's timestamps; no rows for a recording without points.
        """
        path = root / "cache" / f"places-{self.fingerprint}" / f"{entry.sha256}.safetensors"
        if not path.is_file():
            file = RecordingStore.open(root).open_file(Path(entry.file).stem)
            cloud, head = file.part("points"), file.part("head")
            surroundings = VoxelMap(self.encoder.grid)
            if cloud is not None and len(cloud.points_world):
                surroundings.add(cloud.points_world, cloud.first_seen)
            seen = len(head.timestamps) if cloud is not None and len(cloud.points_world) else 0
            code = torch.zeros(seen, self.size, dtype=torch.float16)
            code_mirrored = code.clone()
            for start in range(0, seen, _AT_ONCE):
                part = slice(start, start + _AT_ONCE)
                grids = surroundings.voxelize(head.T_world_device[part], head.timestamps[part])
                with torch.inference_mode():
                    code[part], code_mirrored[part] = self.encoder.encode(grids), self.encoder.encode(mirrored(grids))
            write_tensors(path, {"code": code, "code_mirrored": code_mirrored})
        return path

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        """Compute the missing codes of recordings."""
        for store in stores:
            folder = store.root / "cache" / f"places-{self.fingerprint}"
            codes = {name: folder / f"{store.entries[name].sha256}.safetensors" for name in store.names(split)}
            todo = [name for name, file in codes.items() if not file.is_file()]
            for name in track(todo, f"points of {store.root.name}", disable=not todo):
                self.file_of(store.root, store.entries[name])

    def read(self, store: RecordingStore, name: str, start: int, stop: int, mirrored: bool) -> Features:
        """See `ConditionWindows`. Raises WearcapError as `file_of` does."""
        codes = _codes(str(self.file_of(store.root, store.entries[name])))
        rows, count = codes.get_slice("code_mirrored" if mirrored else "code"), stop - start
        if not rows.get_shape()[0]:
            return torch.zeros(count, self.size), torch.zeros(count, dtype=torch.bool)
        return rows[start:stop].float(), torch.ones(count, dtype=torch.bool)


class Embeddings(ConditionWindows):
    """Embeddings of the recordings' cameras by one encoder."""

    def __init__(self, encoder: str):
        self.encoder, self.size = encoder, 0

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        _, self.size = embeddings_of(self.encoder, [*stores])

    def read(self, store: RecordingStore, name: str, start: int, stop: int, mirrored: bool) -> Features:
        path, count = store.path_of(name), stop - start
        image, valid = torch.zeros(count, self.size), torch.zeros(count, dtype=torch.bool)
        key = "camera.embedding_mirrored" if mirrored else "camera.embedding"
        if _pictured(path) == self.encoder and key in open_recording(path).keys:
            picture, valid = (part[start:stop] for part in _latest(path))
            if valid.any():
                first, last = picture[valid][[0, -1]].tolist()
                shown = open_recording(path).window(key, first, last + 1).float()
                image = shown[(picture - first).clamp(0, len(shown) - 1)]
        return image, valid


_codes = cache(partial(open_tensors, kind="file of places", fix="Delete it: it is made again."))


@cache
def _pictured(path: Path) -> str | None:
    """Name of the encoder whose embeddings a recording has."""
    file = open_recording(path)
    return file.part("camera").embedding_name if "camera.embedding" in file.keys else None


@cache
def _latest(path: Path) -> tuple[Int64[Tensor, "time"], Bool[Tensor, "time"]]:
    file = open_recording(path)
    return latest_before(file.tensor("camera.timestamps"), file.tensor("head.timestamps"))
