"""Head camera frames labelled with the positions of the wearer's own limbs, to train our image encoder."""

import hashlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.utils.data import Dataset

from wearcap.data.datamodule import SeededWindows
from wearcap.data.embeddings import pictures
from wearcap.data.windows import Source
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry.rigid import Rigid
from wearcap.geometry.trajectory import interpolate
from wearcap.recording.motion import Motion
from wearcap.recording.recording import CameraStream
from wearcap.recording.store import RecordingFile, RecordingStore

POINTS = tuple(
    f"{side}_{part}"
    for part in ("palm", "fingertip", "wrist", "elbow", "knee", "toe_tip")
    for side in ("left", "right")
)
"""Joints and sites whose positions in the camera's frame are learned; left and right alternate."""
HANDS = tuple(f"{side}_palm" for side in ("left", "right"))


class EgoFrame(NamedTuple):
    """One frame, or a batch of them (a leading "batch" axis on every field)."""

    picture: UInt8[Tensor, "*batch height width 3"]
    point_cam: Float[Tensor, "*batch point 3"]
    """`POINTS` in the camera's axes (m)."""
    visible: Bool[Tensor, "*batch point"]
    """Whether a point is within the image; occlusion is ignored."""
    intrinsics: Float[Tensor, "*batch 4"]
    """fx, fy, cx, cy of the image (pixels)."""


def limb_points(
    motion: Motion, camera: CameraStream
) -> tuple[Float[Tensor, "time point 3"], Bool[Tensor, "time point"]]:
    """`POINTS` in the camera's axes (m) and whether they are within the image, at the camera's timestamps.

    Raises WearcapError when the motion does not span the camera's timestamps.
    """
    T_world_joint, skeleton = motion.T_world_joint, motion.skeleton
    places = []
    for name in POINTS:
        site = skeleton.sites.get(name)
        joint = T_world_joint[:, skeleton.index(site.joint if site else name)]
        places.append(joint @ torch.tensor(site.t_joint_site) if site else joint.t)
    T_world_cam = motion.joint("head") @ Rigid(camera.R_head_cam, camera.t_head_cam)[None]
    point_cam = T_world_cam.inverse()[:, None] @ torch.stack(places, 1)
    point_cam = interpolate(motion.timestamps, point_cam, camera.timestamps)
    return point_cam, camera.camera.project(point_cam)[1]


class EgoFrames(Dataset):
    """Every `every`-th frame of the recordings of one split that have a motion and a head camera's images.

    Images are decoded once, into arrays in each data set's `cache`, and memory-mapped. Items are indexed by
    (frame, seed), or by frame. Weights are set so that frames that show a hand make up `hand_share` of the draws
    (0: their natural share).
    """

    def __init__(self, sources: list[Source], split: str, every: int, hand_share: float = 0.0):
        self._pictures, self.weights = list[UInt8[np.ndarray, "time height width 3"]](), torch.empty(0)
        points, visible, weights, intrinsics = [], [], [], []
        for source in sources:
            store = RecordingStore.open(source.root)
            for name in store.names(split):
                file = RecordingFile(store.path_of(name))
                camera, motion = file.part("camera"), file.part("motion")
                if not isinstance(camera, CameraStream) or motion is None or not (camera.video or camera.image_files):
                    continue
                frames = decoded(camera, store.root, every)
                of_all = limb_points(motion, camera)
                points.append(of_all[0][::every])
                visible.append(of_all[1][::every])
                weights.append(torch.full((len(frames),), source.weight, dtype=torch.float64))
                lens = camera.camera
                intrinsics.append(torch.tensor([lens.fx, lens.fy, lens.cx, lens.cy]).expand(len(frames), 4))
                self._pictures.append(frames)
        if not points:
            raise WearcapError(
                f"no head camera images in split {split!r}",
                where=", ".join(s.root for s in sources),
                fix="Prepare a data set with them: wearcap prepare simulated camera=true",
            )
        self.point_cam, self.visible, self.weights = torch.cat(points), torch.cat(visible), torch.cat(weights)
        self.intrinsics = torch.cat(intrinsics)
        shown = self.visible[:, [POINTS.index(name) for name in HANDS]].any(-1)
        if hand_share and shown.any() and not shown.all():
            own = self.weights[shown].sum() / self.weights.sum()
            self.weights = self.weights * torch.where(shown, hand_share / own, (1 - hand_share) / (1 - own))
        self._first = np.cumsum([0, *(len(frames) for frames in self._pictures)])

    def __len__(self) -> int:
        return len(self.point_cam)

    def __getitem__(self, item: tuple[int, int] | int) -> EgoFrame:
        index = item[0] if isinstance(item, tuple) else item
        recording = int(np.searchsorted(self._first, index, side="right")) - 1
        picture = self._pictures[recording][index - self._first[recording]]
        return EgoFrame(
            torch.from_numpy(picture.copy()), self.point_cam[index], self.visible[index], self.intrinsics[index]
        )


@cache
def _array(path: Path) -> UInt8[np.ndarray, "time height width 3"]:
    return np.load(path, mmap_mode="r", allow_pickle=False)


def decoded(camera: CameraStream, root: Path, every: int) -> UInt8[np.ndarray, "time height width 3"]:
    """Every `every`-th image of a stream, memory-mapped from a file in `root`/cache that is made if it is missing.

    Raises WearcapError for images of several sizes, another number of them than of timestamps, and as `pictures` does.
    """
    named = camera.video or "\n".join(camera.image_files or ())
    first = root / (camera.video or (camera.image_files or ("",))[0])
    changed = first.stat().st_mtime_ns if first.is_file() else 0
    key = hashlib.sha256(f"{named} {changed} {len(camera.timestamps)} {every}".encode()).hexdigest()[:24]
    path = root / "cache" / "ego_frames" / f"{key}.npy"
    if not path.is_file():
        count, chosen = 0, []
        for count, picture in enumerate(pictures(camera, root), 1):
            if (count - 1) % every == 0:
                chosen.append(picture)
        if count != len(camera.timestamps) or len({picture.shape for picture in chosen}) != 1:
            raise WearcapError(
                f"{count} pictures for {len(camera.timestamps)} timestamps",
                where=first,
                expected="a picture for each timestamp, all of one size",
            )
        with atomic_path(path) as temporary:
            np.save(temporary, np.stack(chosen), allow_pickle=False)
    return _array(path)


class EgoViewFrames(SeededWindows):
    """Lightning data of the image encoder's training; see `EgoFrames`, and `SeededWindows` with frames for windows."""

    def __init__(
        self,
        sources: dict[str, dict | None],
        every: int,
        batch_size: int,
        hand_share: float = 0.0,
        steps_per_epoch: int | None = None,
        val_windows: int | None = None,
        workers: int = 0,
        seed: int = 0,
        val_sources: dict[str, dict | None] | None = None,
    ):
        super().__init__(sources, batch_size, steps_per_epoch, val_windows, workers, seed, val_sources)
        self.every, self.hand_share = every, hand_share

    def dataset(self, split: str) -> EgoFrames:
        """Frames of a split; in the training split frames that show a hand are drawn with `hand_share`."""
        if split == "train":
            return EgoFrames(self.sources, split, self.every, self.hand_share)
        return EgoFrames(self.val_sources, split, self.every)
