"""The visual map of a scene: pictures with known poses, keypoints lifted to 3D and merged to landmarks, and global
descriptors for retrieval.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int8, Int32, Int64

from wearcap.boundary.opening import understood
from wearcap.boundary.tensors import open_described, write_tensors
from wearcap.boundary.texts import require_layout
from wearcap.errors import WearcapError
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.features import Extractor, Vlad

SCHEMA_VERSION = 1
STEPS = 254.0
"""Quantisation of unit-length descriptors to bytes: round(254 d), so components beyond ±0.5 are clipped."""
_CHUNK = 1 << 18
_MIN_COSINE = 0.85
"""Smallest similarity of descriptors that are merged."""
MAP = "wearcap_map"
"""Key of a map's description in its file."""
_AGAIN = "Build it again: wearcap scene."


@dataclass(frozen=True)
class _Header:
    """A map's description in its file: its fields of that name."""

    schema_version: int
    extractor: str
    descriptor: str
    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cell_m: float


@dataclass(frozen=True, eq=False)
class _Landmarks:
    """Scene points at which keypoints were detected."""

    points_world: Float32[np.ndarray, "landmark 3"]
    descriptors: Int8[np.ndarray, "landmark feature"]
    """Mean of the keypoints' descriptors, of unit length."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Keypoints with a 3D position, in the order of their pictures."""

    keypoints: Float32[np.ndarray, "observation 2"]
    descriptors: Int8[np.ndarray, "observation feature"]
    positions: Float32[np.ndarray, "observation 3"]
    """World position (m), lifted in the observation's own picture."""
    first: Int64[np.ndarray, "edge"]
    """Picture i has the observations first[i] … first[i + 1] - 1."""
    landmark: Int32[np.ndarray, "observation"]
    """Index of the observed landmark."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def of(self, picture: int) -> slice:
        """The observations of one picture."""
        return slice(int(self.first[picture]), int(self.first[picture + 1]))


@dataclass(frozen=True, eq=False)
class VisualMap:
    """A map that cameras are localised against; `map_builder.build_map` makes one."""

    extractor: str
    """Name of the extractor that found the keypoints."""
    descriptor: str
    """Name of the global descriptor."""
    names: tuple[str, ...]
    """File name of each picture."""
    cameras: tuple[Camera, ...]
    """Camera of each picture; the perspective camera where a fisheye was undistorted."""
    T_world_cam: Rigid
    """Pose of each picture (float64)."""
    global_descriptors: Float32[np.ndarray, "image global"]
    observations: Observations
    landmarks: _Landmarks
    vocabulary: Float32[np.ndarray, "word feature"]
    """VLAD's vocabulary; empty where another global descriptor is used."""
    cell_m: float
    """Size of the cells (m) within which observations are merged into landmarks; 0: merged at equal positions."""

    def __len__(self) -> int:
        return len(self.names)

    def landmarks_of(self, pictures: Int64[np.ndarray, "chosen"], count: int) -> Int64[np.ndarray, "landmark"]:
        """Landmarks that the pictures observe; of more than `count`, those observed most."""
        seen = [self.observations.landmark[self.observations.of(picture)] for picture in pictures.tolist()]
        views = np.bincount(np.concatenate([np.zeros(0, np.int32), *seen]))
        landmark = np.flatnonzero(views)
        if len(landmark) > count:
            landmark = np.sort(landmark[np.argsort(-views[landmark], kind="stable")[:count]])
        return landmark

    def nearest(self, prior: Rigid, count: int) -> Int64[np.ndarray, "chosen"]:
        """Pictures taken near a pose and in its direction: 1 m counts as much as 30°."""
        t, forward = prior.t.double().cpu().numpy(), prior.R[:, 2].double().cpu().numpy()
        distance = np.linalg.norm(self.T_world_cam.t.numpy() - t, axis=1)
        angle = np.arccos(np.clip(self.T_world_cam.R.numpy()[:, :, 2] @ forward, -1, 1))
        return np.argsort(distance + angle / np.radians(30), kind="stable")[:count].astype(np.int64)

    def require_features(self, extractor: Extractor) -> None:
        """Raises WearcapError when the map was made with another extractor or another global descriptor than VLAD."""
        for mine, name, made, part, what in (
            (self.extractor, extractor.name, f"{self.extractor!r} features", "features", "extractor"),
            (
                self.descriptor,
                Vlad(self.vocabulary).name,
                f"the global descriptor {self.descriptor!r}",
                "descriptor",
                "descriptor",
            ),
        ):
            if name != mine:
                expected = f"the same {part} in map and picture"
                fix = f"Build the map again, or choose its {what}."
                raise WearcapError(f"the map was made with {made}, not {name!r}", expected=expected, fix=fix)

    def save(self, path: str | Path) -> None:
        """Write one .safetensors file, atomically."""
        header = _Header(SCHEMA_VERSION, self.extractor, self.descriptor, self.names, self.cameras, float(self.cell_m))
        arrays = {
            "R_world_cam": self.T_world_cam.R,
            "t_world_cam": self.T_world_cam.t,
            "global_descriptors": self.global_descriptors,
            "vocabulary": self.vocabulary,
            **vars(self.observations),
            **{f"landmarks.{name}": array for name, array in vars(self.landmarks).items()},
        }
        write_tensors(path, arrays, {MAP: json.dumps(dataclasses.asdict(header), sort_keys=True)})

    @classmethod
    def load(cls, path: str | Path) -> "VisualMap":
        """Read a map. Raises WearcapError for a file that is missing, damaged, no map, or of another version."""
        file, content = open_described(path, MAP, "visual map", "`wearcap scene`", _AGAIN)
        with understood("a damaged map", path, fix=_AGAIN):
            if (version := content["schema_version"]) != SCHEMA_VERSION:
                raise WearcapError(f"a map of version {version}", path, f"version {SCHEMA_VERSION}", _AGAIN)
            header = require_layout(content, _Header, path)
            arrays = {name: file.get_tensor(name).numpy() for name in file.keys()}  # noqa: SIM118
            loaded = cls(
                header.extractor,
                header.descriptor,
                header.names,
                header.cameras,
                Rigid(*(torch.from_numpy(arrays[name]) for name in ("R_world_cam", "t_world_cam"))),
                arrays["global_descriptors"],
                Observations(**{field.name: arrays[field.name] for field in dataclasses.fields(Observations)}),
                _Landmarks(arrays["landmarks.points_world"], arrays["landmarks.descriptors"]),
                arrays["vocabulary"],
                header.cell_m,
            )
            loaded.check()
        return loaded

    def check(self) -> None:
        """Raises ValueError when the parts do not fit together."""
        seen = self.observations
        images, observations, landmarks = len(self.names), len(seen), len(self.landmarks.points_world)
        for name, part, expected in (
            ("cameras", self.cameras, images),
            ("poses", self.T_world_cam.R, images),
            ("positions of pictures", self.T_world_cam.t, images),
            ("global descriptors", self.global_descriptors, images),
            ("edges", seen.first, images + 1),
            ("descriptors", seen.descriptors, observations),
            ("positions", seen.positions, observations),
            ("numbers of landmarks", seen.landmark, observations),
            ("descriptors of landmarks", self.landmarks.descriptors, landmarks),
        ):
            if len(part) != expected:
                raise ValueError(f"{len(part)} {name} instead of {expected}")
        if seen.first[0] != 0 or seen.first[-1] != observations or (np.diff(seen.first) < 0).any():
            raise ValueError("its pictures do not share out the observations")
        if observations and not 0 <= seen.landmark.min() <= seen.landmark.max() < landmarks:
            raise ValueError("observations of landmarks that are not there")


def to_bytes(descriptors: Float32[np.ndarray, "keypoint feature"]) -> Int8[np.ndarray, "keypoint feature"]:
    """Descriptors of unit length in a quarter of the memory."""
    return np.clip(np.rint(descriptors * STEPS), -127, 127).astype(np.int8)


def from_bytes(descriptors: Int8[np.ndarray, "keypoint feature"]) -> Float32[np.ndarray, "keypoint feature"]:
    """Descriptors of unit length again."""
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)


def merge(
    positions: Float32[np.ndarray, "observation 3"], descriptors: Int8[np.ndarray, "observation feature"], cell_m: float
) -> tuple[_Landmarks, Int32[np.ndarray, "observation"]]:
    """Landmarks, and the one that each observation belongs to.

    Observations within one cell of `cell_m` are one landmark where their descriptors are alike. With `cell_m` 0 those
    at exactly the same position are, whatever their descriptors (tracks of structure from motion).
    """
    if not len(positions):
        return _Landmarks(positions, descriptors), np.zeros(0, np.int32)
    place = positions if cell_m == 0 else np.floor(positions / cell_m).astype(np.int64)
    group = np.unique(place, axis=0, return_inverse=True)[1].ravel()
    if cell_m > 0:
        # Each observation's group is its leader: repeatedly, the first remaining one of each cell collects the similar
        # ones of that cell.
        cell, group, left = group, np.arange(len(group)), np.arange(len(group))
        for _ in range(12):
            _, first = np.unique(cell[left], return_index=True)
            lead_of_cell = np.full(cell.max() + 1, -1)
            lead_of_cell[cell[left[first]]] = left[first]
            lead = lead_of_cell[cell[left]]
            chunks = [slice(k, k + _CHUNK) for k in range(0, len(left), _CHUNK)]
            pairs = ((from_bytes(descriptors[left[part]]), from_bytes(descriptors[lead[part]])) for part in chunks)
            alike = np.concatenate([np.einsum("nd,nd->n", *pair) for pair in pairs]) >= _MIN_COSINE
            alike[first] = True
            group[left[alike]] = lead[alike]
            left = left[~alike]
            if not len(left):
                break
    _, landmark, count = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(landmark, kind="stable")
    start = np.cumsum(count) - count
    mean = np.add.reduceat(positions[order].astype(np.float64), start) / count[:, None]
    total = np.add.reduceat(descriptors[order].astype(np.float32), start)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-6)
    return _Landmarks(mean.astype(np.float32), to_bytes(total)), landmark.astype(np.int32)
