"""Conditions of a window beside the head's path: codes of the points around the body, and image embeddings."""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path

import torch
from jaxtyping import Bool, Float64, Int64
from rich.progress import track
from torch import Tensor

from wearcap.boundary.tensors import open_tensors, write_tensors
from wearcap.data.windows import open_recording
from wearcap.errors import WearcapError
from wearcap.models.checkpoint import load_network
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording.store import Entry, RecordingStore
from wearcap.scene.voxels import VoxelMap, mirrored

MAX_PICTURE_AGE_S = 0.2
"""Largest age (s) at which an image still conditions a frame."""
_AT_ONCE = 2048
"""Grids that are encoded at a time."""


class PlaceCodes:
    """Codes of the points around the body by a trained voxel autoencoder (thesis §6.2)."""

    def __init__(self, checkpoint: str | Path):
        """`checkpoint`: path or name of a checkpoint of experiment=voxel_autoencoder."""
        self.checkpoint = checkpoint

    @cached_property
    def encoder(self) -> VoxelAutoencoder:
        """The network, in evaluation mode. Raises WearcapError when the checkpoint is missing or another network's."""
        return load_network(self.checkpoint, VoxelAutoencoder, "voxel_autoencoder").requires_grad_(False)

    @property
    def size(self) -> int:
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

    def prepare(self, store: RecordingStore, names: Iterable[str]) -> None:
        """Compute the missing codes of recordings."""
        folder = store.root / "cache" / f"places-{self.fingerprint}"
        todo = [name for name in names if not (folder / f"{store.entries[name].sha256}.safetensors").is_file()]
        for name in track(todo, f"points of {store.root.name}", disable=not todo):
            self.file_of(store.root, store.entries[name])


@dataclass(frozen=True)
class Surroundings:
    """Modalities that windows contain; None leaves one out (no columns)."""

    places: PlaceCodes | None = None
    images: str | None = None
    """Name of the encoder whose embeddings are read from the recordings' cameras."""

    def read(
        self, store: RecordingStore, name: str, start: int, stop: int, mirrored: bool, image_size: int
    ) -> dict[str, Tensor]:
        """Point codes ("points") and image embeddings ("image") of frames start…stop-1 of the head stream, and which
        frames have them ("points_valid", "image_valid"); with `mirrored`, of the surroundings mirrored left to right.

        Raises WearcapError as `PlaceCodes.file_of` does.
        """
        path, count = store.path_of(name), stop - start
        points, points_valid = torch.zeros(count, 0), torch.zeros(count, dtype=torch.bool)
        if self.places is not None:
            points = torch.zeros(count, self.places.size)
            codes = _codes(str(self.places.file_of(store.root, store.entries[name])))
            rows = codes.get_slice("code_mirrored" if mirrored else "code")
            if rows.get_shape()[0]:
                points, points_valid = rows[start:stop].float(), torch.ones(count, dtype=torch.bool)
        image, image_valid = torch.zeros(count, image_size), torch.zeros(count, dtype=torch.bool)
        key = "camera.embedding_mirrored" if mirrored else "camera.embedding"
        if self.images is not None and _pictured(path) == self.images and key in open_recording(path).keys:
            picture, image_valid = (part[start:stop] for part in _latest(path))
            if image_valid.any():
                first, last = picture[image_valid][[0, -1]].tolist()
                shown = open_recording(path).window(key, first, last + 1).float()
                image = shown[(picture - first).clamp(0, len(shown) - 1)]
        return {"points": points, "points_valid": points_valid, "image": image, "image_valid": image_valid}


NOTHING = Surroundings()

_ENCODER_NAME = re.compile(r"[\w.-]+")
"""Names become values of the training's config, in which `${…}` would be resolved."""


def embeddings_of(encoder: str, stores: list[RecordingStore]) -> tuple[str, int]:
    """Full name (`NAME-FINGERPRINT` of its weights) and dimension of an encoder's embeddings in data sets.

    `encoder` is the full name or NAME alone. Raises WearcapError when there are none, or several kinds.
    """
    kinds: set[tuple[str, int]] = set()
    for file in (open_recording(store.path_of(name)) for store in stores for name in store.names()):
        full = _pictured(file.path)
        if full is not None and not _ENCODER_NAME.fullmatch(full):
            raise WearcapError(f"embeddings of {full[:80]!r}", where=file.path, expected="the plain name of an encoder")
        if full is not None and (full == encoder or full.startswith(f"{encoder}-")):
            kinds.add((full, file.tensor("camera.embedding").shape[1]))
    if len(kinds) != 1:
        found = ", ".join(f"{name} with {size} features" for name, size in sorted(kinds))
        what = f"embeddings of several kinds: {found}" if kinds else f"no recording has embeddings of {encoder!r}"
        expected = f"embeddings of one {encoder!r}"
        fix = f"Run: wearcap prepare embeddings dataset=DIR encoder={encoder.split('-')[0]}"
        raise WearcapError(what, where=", ".join(str(store.root) for store in stores), expected=expected, fix=fix)
    return kinds.pop()


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


def latest_before(
    timestamps: Float64[Tensor, "picture"], wanted: Float64[Tensor, "time"]
) -> tuple[Int64[Tensor, "time"], Bool[Tensor, "time"]]:
    """Index of the newest image at each time (30 Hz images serve two frames at 60 Hz), and whether it is recent."""
    if not len(timestamps):
        return torch.zeros(len(wanted), dtype=torch.long), torch.zeros(len(wanted), dtype=torch.bool)
    newest = torch.searchsorted(timestamps.contiguous(), wanted + 1e-4, right=True) - 1
    number = newest.clamp_min(0)
    return number, (newest >= 0) & (wanted - timestamps[number] < MAX_PICTURE_AGE_S)
