"""Codes of the points around the body at every frame of a recording, cached beside the data per encoder."""

import hashlib
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float16
from rich.progress import track
from safetensors.torch import save
from torch import Tensor

from wearcap.files import atomic_path
from wearcap.models.checkpoint import load_network
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import HeadStream, PointCloud
from wearcap.recording.store import Entry, RecordingStore
from wearcap.scene.voxels import VoxelMap, mirrored

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
            self._make(path, root, entry)
        return path

    def prepare(self, store: RecordingStore, names: Iterable[str]) -> None:
        """Compute the missing codes of recordings."""
        folder = store.root / "cache" / f"places-{self.fingerprint}"
        todo = [name for name in names if not (folder / f"{store.entries[name].sha256}.safetensors").is_file()]
        for name in track(todo, f"points of {store.root.name}", disable=not todo):
            self.file_of(store.root, store.entries[name])

    def _make(self, path: Path, root: Path, entry: Entry) -> None:
        file = RecordingStore.open(root).open_file(Path(entry.file).stem)
        code, code_mirrored = place_codes(file.part("points"), file.part("head"), self.encoder)
        with atomic_path(path) as temporary:
            temporary.write_bytes(save({"code": code, "code_mirrored": code_mirrored}))


@torch.inference_mode()
def place_codes(
    cloud: PointCloud | None, head: HeadStream, encoder: VoxelAutoencoder
) -> tuple[Float16[Tensor, "time feature"], Float16[Tensor, "time feature"]]:
    """Codes of the points that had been seen by each head frame, and of the same points mirrored left to right.

    No rows without points.
    """
    has_points = cloud is not None and len(cloud.points_world) > 0
    code = torch.zeros(len(head.timestamps) if has_points else 0, encoder.size, dtype=torch.float16)
    code_mirrored = code.clone()
    if cloud is None or not has_points:
        return code, code_mirrored
    surroundings = VoxelMap(encoder.grid)
    surroundings.add(cloud.points_world, cloud.first_seen)
    for start in range(0, len(code), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        grids = surroundings.voxelize(head.T_world_device[part], head.timestamps[part])
        code[part], code_mirrored[part] = encoder.encode(grids), encoder.encode(mirrored(grids))
    return code, code_mirrored
