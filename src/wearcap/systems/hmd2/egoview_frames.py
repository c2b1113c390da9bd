"""Head camera frames labelled with the positions of the wearer's own limbs, to train our image encoder.

Batches of them are augmented: light and colours, the camera's rotation on the head, mirror images. Augmented images are
normalised and have the encoder's size; random numbers come from torch's default generator.
"""

import hashlib
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn import functional as F

from wearcap.data.pictures import pictures
from wearcap.data.windows import Source
from wearcap.errors import WearcapError
from wearcap.files import atomic_path
from wearcap.geometry import rotation
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
_SWAPPED = [index ^ 1 for index in range(len(POINTS))]
"""Index of each point's counterpart on the other side."""


class EgoFrame(NamedTuple):
    """A batch of frames."""

    picture: UInt8[Tensor, "batch height width 3"]
    point_cam: Float[Tensor, "batch point 3"]
    """`POINTS` in the camera's axes (m)."""
    visible: Bool[Tensor, "batch point"]
    """Whether a point is within the image; occlusion is ignored."""
    intrinsics: Float[Tensor, "batch 4"]
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


class EgoFrames:
    """Every `every`-th frame of the recordings of one split that have a motion and a head camera's images.

    Images are decoded once, into arrays in each data set's `cache`, and kept in memory.
    """

    def __init__(
        self, sources: Sequence[Source], split: str, augmented: bool = False, *, every: int, hand_share: float = 0.0
    ):
        """In training, frames that show a hand make up `hand_share` of the draws (0: their natural share).

        Augmentation is the training's, which works on whole batches. Raises WearcapError for a split without images.
        """
        shown_frames = list[UInt8[np.ndarray, "time height width 3"]]()
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
                shown_frames.append(frames)
        if not points:
            what = f"no head camera images in split {split!r}"
            fix = "Prepare a data set with them: wearcap prepare simulated camera=true"
            raise WearcapError(what, where=", ".join(s.root for s in sources), fix=fix)
        self.point_cam, self.visible, self.weights = torch.cat(points), torch.cat(visible), torch.cat(weights)
        self.intrinsics = torch.cat(intrinsics)
        shown = self.visible[:, [POINTS.index(name) for name in HANDS]].any(-1)
        if hand_share and split == "train" and shown.any() and not shown.all():
            own = self.weights[shown].sum() / self.weights.sum()
            self.weights = self.weights * torch.where(shown, hand_share / own, (1 - hand_share) / (1 - own))
        self.pictures = torch.from_numpy(np.concatenate(shown_frames))

    def __len__(self) -> int:
        return len(self.point_cam)

    def batch(self, index: Int64[Tensor, "batch"], seed: Int64[Tensor, "batch"]) -> EgoFrame:
        """Frames by their numbers; nothing of them is random."""
        return EgoFrame(self.pictures[index], self.point_cam[index], self.visible[index], self.intrinsics[index])


@cache
def _array(path: Path) -> UInt8[np.ndarray, "time height width 3"]:
    return np.load(path, mmap_mode="r", allow_pickle=False)


def decoded(camera: CameraStream, root: Path, every: int) -> UInt8[np.ndarray, "time height width 3"]:
    """Every `every`-th image of a stream, memory-mapped from a file in `root`/cache that is made if it is missing.

    Raises WearcapError for images of several sizes, another number of them than of timestamps, and as `pictures` does.
    """
    named = camera.video or "\n".join(camera.image_files or ())
    first = camera.files_in(root)[0]
    changed = first.stat().st_mtime_ns if first.is_file() else 0
    key = hashlib.sha256(f"{named} {changed} {len(camera.timestamps)} {every}".encode()).hexdigest()[:24]
    path = root / "cache" / "ego_frames" / f"{key}.npy"
    if not path.is_file():
        count, chosen = 0, []
        for count, picture in enumerate(pictures(camera, root), 1):
            if (count - 1) % every == 0:
                chosen.append(picture)
        if count != len(camera.timestamps) or len({picture.shape for picture in chosen}) != 1:
            what = f"{count} pictures for {len(camera.timestamps)} timestamps"
            raise WearcapError(what, where=first, expected="a picture for each timestamp, all of one size")
        with atomic_path(path) as temporary:
            np.save(temporary, np.stack(chosen), allow_pickle=False)
    return _array(path)


def relit(pictures: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch 3 height width"]:
    """Images with random gain, shift, channel mixing and noise, drawn per image."""
    like = pictures[:, :1, :1, :1]
    mix = torch.eye(3, device=pictures.device) + 0.3 * torch.randn(len(pictures), 3, 3, device=pictures.device)
    mix = mix / mix.sum(-1, keepdim=True).clamp_min(0.3)
    pictures = (mix @ pictures.flatten(2)).unflatten(2, pictures.shape[2:])
    gain, shift = (0.25 * torch.randn_like(like)).exp(), 0.3 * torch.randn_like(like)
    noise = 0.15 * torch.rand_like(like) * torch.randn_like(pictures)
    return (gain * pictures + shift + noise).clamp(-2.0, 2.4)


def turned(
    pictures: Float[Tensor, "batch 3 height width"],
    intrinsics: Float[Tensor, "batch 4"],
    point_cam: Float[Tensor, "batch point 3"],
    visible: Bool[Tensor, "batch point"],
    deviation_deg: float,
) -> tuple[Float[Tensor, "batch 3 height width"], Float[Tensor, "batch point 3"], Bool[Tensor, "batch point"]]:
    """Images and points as seen by a slightly rotated camera, with angles of `deviation_deg` per axis.

    `intrinsics` are fx, fy, cx, cy of the images (lens distortion is ignored, as rotations are small). Areas outside
    the original image are grey, and points there are not visible.
    """
    height, width = pictures.shape[2:]
    axis = math.radians(deviation_deg) * torch.randn(len(pictures), 3, device=pictures.device)
    R = rotation.exp(axis)
    focal, centre = intrinsics[:, None, :2], intrinsics[:, None, 2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(1, -1, 2).to(pictures)
    ray = F.pad((pixels - centre) / focal, (0, 1), value=1.0) @ R  # by the inverse of R, row by row
    source = ray[..., :2] / ray[..., 2:].clamp_min(0.1) * focal + centre
    size = pictures.new_tensor([width, height])
    grid = ((2 * source + 1) / size - 1).unflatten(1, (height, width))
    moved = point_cam @ R.transpose(1, 2)
    drawn = moved[..., :2] / moved[..., 2:].clamp_min(1e-3) * focal + centre
    inside = ((drawn >= -0.5) & (drawn < size - 0.5)).all(-1) & (moved[..., 2] > 0)
    return F.grid_sample(pictures, grid, align_corners=False), moved, visible & inside


def half_mirrored(
    pictures: Float[Tensor, "batch 3 height width"],
    point_cam: Float[Tensor, "batch point 3"],
    visible: Bool[Tensor, "batch point"],
) -> tuple[Float[Tensor, "batch 3 height width"], Float[Tensor, "batch point 3"], Bool[Tensor, "batch point"]]:
    """A random half of the images flipped horizontally, with left and right points exchanged."""
    flip = torch.rand(len(pictures), device=pictures.device) < 0.5
    across = point_cam.new_tensor([-1.0, 1.0, 1.0])
    return (
        torch.where(flip[:, None, None, None], pictures.flip(-1), pictures),
        torch.where(flip[:, None, None], point_cam[:, _SWAPPED] * across, point_cam),
        torch.where(flip[:, None], visible[:, _SWAPPED], visible),
    )
