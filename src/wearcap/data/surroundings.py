"""Conditions of a window beside the head's path: codes of the points around the body, image embeddings, hands in view."""

import hashlib
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from rich.progress import track
from torch import Tensor

from wearcap.body.skeleton import WRISTS
from wearcap.boundary.tensors import read_tensors, write_tensors
from wearcap.data.batch import Batch
from wearcap.data.bodies import places_in_parts
from wearcap.data.packing import Track
from wearcap.data.view import HandsInView
from wearcap.errors import WearcapError
from wearcap.geometry import rotation
from wearcap.geometry.rigid import Rigid
from wearcap.models.checkpoint import load_network
from wearcap.models.voxel_autoencoder import VoxelAutoencoder
from wearcap.recording import Recording
from wearcap.recording.store import Entry, RecordingFile, RecordingStore
from wearcap.scene.voxels import VoxelMap, mirrored

MAX_PICTURE_AGE_S = 0.2
"""Largest age (s) at which an image still conditions a frame."""
_AT_ONCE = 2048
"""Grids that are encoded at a time."""


Rows = tuple[Float[Tensor, "row side feature"], Int[Tensor, "time"]]
"""Features of a recording, on both sides of a mirror, and the row of each frame (-1: it has none)."""
Features = tuple[Float[Tensor, "*batch time feature"], Bool[Tensor, "*batch time"]]
"""Features of a condition, and which frames have them; elsewhere they are any finite numbers."""


class ConditionWindows:
    """A condition in training windows: its features at the frames of a recording's head stream, of rows of a table or, by
    other `track` and `read`, of further values of the windows."""

    metric: ClassVar[bool] = False
    """Whether features depend on lengths, so that windows cannot be scaled."""
    size: int
    """Number of features of a frame, known after `prepare`."""
    encoder: Any = None
    """The network that made them, or its name; None: none did."""

    key: str = ""
    """What the features depend on beside the recording."""
    twins: ClassVar[dict[str, list[int]]] = {}
    sensed: ClassVar[frozenset[str]] = frozenset()
    parts: ClassVar[frozenset[str]] = frozenset()
    """Of the values that it adds to windows: see `Batch`."""

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        """Make or check what reading the recordings of a split needs."""

    def frames(self, store: RecordingStore, name: str) -> Rows:
        """Features of a recording, of everything as it is and mirrored left to right, and the row of each head pose."""
        raise NotImplementedError

    def track(self, name: str, store: RecordingStore, recording: Recording, stem: str) -> Track:
        """What is kept of a recording for the condition of a name."""
        table, row = self.frames(store, stem)
        return Track({name: row}, {}, {name: table})

    def read(self, name: str, batch: Batch, values: dict[str, Tensor]) -> Features:
        """Features of a batch of windows, and which frames have them; takes what is its own out of the windows' values.

        Nobody else has the surroundings that a recording was made in."""
        row, side = values.pop(name), torch.zeros_like(batch.track)
        if batch.mirrored is not None:
            side = batch.mirrored.long()
        given = row >= 0
        if batch.others is not None:
            given = given & ~batch.others[:, None]
        return batch.packed.tables[name][row, side[:, None]].float(), given


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

    @property
    def key(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.fingerprint

    def frames(self, store: RecordingStore, name: str) -> Rows:
        """See `ConditionWindows`. Raises WearcapError as `file_of` does."""
        path = self.file_of(store.root, store.entries[name])
        _, codes = read_tensors(path, "file of places", fix="Delete it: it is made again.")
        table = torch.stack([codes["code"], codes["code_mirrored"]], 1)
        count = RecordingFile(store.path_of(name)).length("head.timestamps")
        row = torch.arange(count) if len(table) else torch.full((count,), -1)
        return table, row.int()


class Embeddings(ConditionWindows):
    """Embeddings of the recordings' cameras by one encoder."""

    def __init__(self, encoder: str, size: int | None = None):
        """`size`: number of features, of embeddings that no recording needs to have; None: as the recordings say."""
        self.encoder, self.size, self._given = encoder, size or 0, size

    def prepare(self, stores: Sequence[RecordingStore], split: str) -> None:
        if self._given is None:
            _, self.size = embeddings_of(self.encoder, [*stores])

    @property
    def key(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.encoder

    def frames(self, store: RecordingStore, name: str) -> Rows:
        file = RecordingFile(store.path_of(name))
        count = file.length("head.timestamps")
        if _pictured(file) != self.encoder or "camera.embedding_mirrored" not in file.keys:
            return torch.zeros(0, 2, self.size).half(), torch.full((count,), -1).int()
        table = torch.stack([file.tensor("camera.embedding"), file.tensor("camera.embedding_mirrored")], 1)
        picture, valid = latest_before(file.tensor("camera.timestamps"), file.tensor("head.timestamps"))
        return table.half(), torch.where(valid, picture, -1).int()


HAND = 10
"""Features of a hand: whether it is seen, its place (m) and its orientation in 6D."""


def hand_features(
    T_world_head: Rigid, T_world_wrist: Rigid, seen: Bool[Tensor, "*batch time hand"]
) -> Float[Tensor, "*batch time feature"]:
    """Both hands from the head, along its heading: 1, place and orientation of a hand that is seen, otherwise zeros."""
    heading = rotation.about_axis("z", rotation.yaw_of(T_world_head.R)).mT[..., None, :, :]
    t = (heading @ (T_world_wrist.t - T_world_head.t[..., None, :])[..., None])[..., 0]
    R = rotation.rot6d_from_matrix(heading @ T_world_wrist.R)
    shown = seen[..., None]
    return torch.where(shown, torch.cat([shown.to(t), t, R], -1), 0.0).flatten(-2)


class SeenHands(ConditionWindows):
    """True wrists where a head-mounted device would find them."""

    size = HAND * len(WRISTS)
    twins: ClassVar[dict[str, list[int]]] = {"R_world_wrist": [1, 0], "t_world_wrist": [1, 0]}
    sensed = frozenset(twins)
    parts = frozenset({"t_world_wrist"})

    def __init__(self, view: HandsInView | None = None):
        self.view = view or HandsInView()

    def track(self, name: str, store: RecordingStore, recording: Recording, stem: str) -> Track:
        motion = recording.motion
        assert motion is not None
        R_world_wrist = motion.T_world_joint.R[:, motion.skeleton.indices(*WRISTS)]
        return Track({"R_world_wrist": R_world_wrist, "t_world_wrist": places_in_parts(motion, WRISTS)})

    def read(self, name: str, batch: Batch, values: dict[str, Tensor]) -> Features:
        T_world_wrist = Rigid(values.pop("R_world_wrist"), values.pop("t_world_wrist"))
        T_world_head = Rigid(values["R_world_head"], values["t_world_head"])
        seen = self.view(T_world_head, T_world_wrist.t, batch)
        return hand_features(T_world_head, T_world_wrist, seen), seen.any(-1)


_ENCODER_NAME = re.compile(r"[\w.-]+")
"""Names become values of the training's config, in which `${…}` would be resolved."""


def embeddings_of(encoder: str, stores: list[RecordingStore]) -> tuple[str, int]:
    """Full name (`NAME-FINGERPRINT` of its weights) and dimension of an encoder's embeddings in data sets.

    `encoder` is the full name or NAME alone. Raises WearcapError when there are none, or several kinds.
    """
    kinds: set[tuple[str, int]] = set()
    for file in (RecordingFile(store.path_of(name)) for store in stores for name in store.names()):
        full = _pictured(file)
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


def _pictured(file: RecordingFile) -> str | None:
    """Name of the encoder whose embeddings a recording has."""
    return file.part("camera").embedding_name if "camera.embedding" in file.keys else None


def latest_before(
    timestamps: Float64[Tensor, "picture"], wanted: Float64[Tensor, "time"]
) -> tuple[Int64[Tensor, "time"], Bool[Tensor, "time"]]:
    """Index of the newest image at each time (30 Hz images serve two frames at 60 Hz), and whether it is recent."""
    if not len(timestamps):
        return torch.zeros(len(wanted), dtype=torch.long), torch.zeros(len(wanted), dtype=torch.bool)
    newest = torch.searchsorted(timestamps.contiguous(), wanted + 1e-4, right=True) - 1
    number = newest.clamp_min(0)
    return number, (newest >= 0) & (wanted - timestamps[number] < MAX_PICTURE_AGE_S)
