"""The visual map of a scene: images with known poses, keypoints lifted to 3D, and global descriptors for retrieval."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors
import torch
from jaxtyping import Float32, Float64, Int8, Int32, Int64
from safetensors.numpy import save

from wearcap.errors import WearcapError
from wearcap.files import atomic_path, parse_json
from wearcap.geometry.camera import Camera
from wearcap.geometry.rigid import Rigid
from wearcap.localization.landmarks import Landmarks

SCHEMA_VERSION = 1
_ARRAYS = (
    "R_world_cam",
    "t_world_cam",
    "keypoints",
    "descriptors",
    "positions",
    "first",
    "landmark",
    "global_descriptors",
    "vocabulary",
)


@dataclass(frozen=True, eq=False)
class VisualMap:
    """A map that cameras are localised against; `map_builder.build_map` makes one.

    Observations (keypoints with a 3D position) stand in the order of their pictures.
    """

    extractor: str
    """Name of the extractor that found the keypoints."""
    descriptor: str
    """Name of the global descriptor."""
    names: tuple[str, ...]
    """File name of each image."""
    cameras: tuple[Camera, ...]
    """Camera of each image; the perspective camera where a fisheye was undistorted."""
    R_world_cam: Float64[np.ndarray, "image 3 3"]
    t_world_cam: Float64[np.ndarray, "image 3"]
    keypoints: Float32[np.ndarray, "observation 2"]
    descriptors: Int8[np.ndarray, "observation feature"]
    positions: Float32[np.ndarray, "observation 3"]
    """World position (m), lifted in the observation's own image."""
    first: Int64[np.ndarray, "edge"]
    """Image i has the observations first[i] … first[i + 1] - 1."""
    landmark: Int32[np.ndarray, "observation"]
    """Index of the observed landmark."""
    landmarks: Landmarks
    global_descriptors: Float32[np.ndarray, "image global"]
    vocabulary: Float32[np.ndarray, "word feature"]
    """VLAD's vocabulary; empty where another global descriptor is used."""
    cell_m: float
    """Size of the cells (m) within which observations are merged into landmarks; 0: merged at equal positions."""

    def __len__(self) -> int:
        return len(self.names)

    @property
    def T_world_cam(self) -> Rigid:
        return Rigid(torch.from_numpy(self.R_world_cam), torch.from_numpy(self.t_world_cam))

    def observations(self, image: int) -> slice:
        """The observations of one picture."""
        return slice(int(self.first[image]), int(self.first[image + 1]))

    def landmark_views(self, images: Int64[np.ndarray, "chosen"]) -> Int64[np.ndarray, "landmark"]:
        """How often each landmark is observed by the given pictures."""
        seen = [self.landmark[self.observations(image)] for image in images.tolist()]
        return np.bincount(np.concatenate([np.zeros(0, np.int32), *seen]), minlength=len(self.landmarks.points_world))

    def save(self, path: str | Path) -> None:
        """Write one .safetensors file, atomically."""
        header = {
            "schema_version": SCHEMA_VERSION,
            "extractor": self.extractor,
            "descriptor": self.descriptor,
            "names": self.names,
            "cameras": [dataclasses.asdict(camera) for camera in self.cameras],
            "cell_m": self.cell_m,
        }
        tensors = {name: np.ascontiguousarray(getattr(self, name)) for name in _ARRAYS}
        tensors |= {f"landmarks.{f.name}": getattr(self.landmarks, f.name) for f in dataclasses.fields(Landmarks)}
        with atomic_path(path) as temporary:
            temporary.write_bytes(save(tensors, {"wearcap_map": json.dumps(header, sort_keys=True)}))

    @classmethod
    def load(cls, path: str | Path) -> "VisualMap":
        """Read a map. Raises WearcapError for a file that is missing, damaged, no map, or of another version."""
        try:
            with safetensors.safe_open(str(path), framework="numpy") as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except FileNotFoundError as error:
            raise WearcapError("no such map", where=path, fix="Build it: wearcap scene.") from error
        except (safetensors.SafetensorError, OSError, RuntimeError) as error:
            raise WearcapError(
                "not a readable map",
                where=path,
                expected="a complete .safetensors file",
                fix="Build it again: wearcap scene.",
            ) from error
        if "wearcap_map" not in metadata:
            raise WearcapError(
                "a .safetensors file, but not a visual map", where=path, expected="one that `wearcap scene` wrote"
            )
        try:
            header = parse_json(metadata["wearcap_map"], path)
            if header["schema_version"] != SCHEMA_VERSION:
                raise WearcapError(
                    f"a map of version {header['schema_version']}",
                    where=path,
                    expected=f"version {SCHEMA_VERSION}",
                    fix="Build it again: wearcap scene.",
                )
            landmarks = Landmarks(**{f.name: tensors[f"landmarks.{f.name}"] for f in dataclasses.fields(Landmarks)})
            cameras = tuple(
                Camera(**camera | {"distortion": tuple(camera["distortion"])}) for camera in header["cameras"]
            )
            loaded = cls(
                header["extractor"],
                header["descriptor"],
                tuple(header["names"]),
                cameras,
                landmarks=landmarks,
                cell_m=float(header["cell_m"]),
                **{name: tensors[name] for name in _ARRAYS},
            )
            loaded.check()
        except (KeyError, TypeError, ValueError) as error:
            raise WearcapError(f"a damaged map ({error})", where=path, fix="Build it again: wearcap scene.") from error
        return loaded

    def check(self) -> None:
        """Raises ValueError when the parts do not fit together."""
        images, observations, landmarks = (len(self.names), len(self.keypoints), len(self.landmarks.points_world))
        sizes = {
            "cameras": (len(self.cameras), images),
            "poses": (len(self.R_world_cam), images),
            "positions of pictures": (len(self.t_world_cam), images),
            "global descriptors": (len(self.global_descriptors), images),
            "edges": (len(self.first), images + 1),
            "descriptors": (len(self.descriptors), observations),
            "positions": (len(self.positions), observations),
            "numbers of landmarks": (len(self.landmark), observations),
            "descriptors of landmarks": (len(self.landmarks.descriptors), landmarks),
        }
        for name, (count, expected) in sizes.items():
            if count != expected:
                raise ValueError(f"{count} {name} instead of {expected}")
        if self.first[0] != 0 or self.first[-1] != observations or (np.diff(self.first) < 0).any():
            raise ValueError("its pictures do not share out the observations")
        if observations and not 0 <= self.landmark.min() <= self.landmark.max() < landmarks:
            raise ValueError("observations of landmarks that are not there")
