"""SuperPoint (DeTone, Malisiewicz & Rabinovich 2018): keypoints and descriptors of a grey image in one pass.

Layers carry the names of the published weights (`superpoint_v1.pth`), so that a user's file loads as it is.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

CELL = 8  # pixels per cell of the coarse maps


def _pooled_max(x: Float[Tensor, "batch height width"], radius: int) -> Float[Tensor, "batch height width"]:
    # The maximum over a square is one over rows, then one over columns: 18 comparisons a pixel instead of 81.
    rows = F.max_pool2d(x, (1, 2 * radius + 1), 1, (0, radius))
    return F.max_pool2d(rows, (2 * radius + 1, 1), 1, (radius, 0))


def suppress(
    heat: Float[Tensor, "batch height width"], radius: int, rounds: int = 3
) -> Float[Tensor, "batch height width"]:
    """Non-maximum suppression: `heat` at its maxima, 0 elsewhere.

    Each round keeps the maxima of the (2 radius + 1)² squares among the pixels that are not suppressed yet, which
    approximates greedy suppression in order of score; published weights are used with three rounds. Equal neighbours
    are all kept.
    """
    zero = torch.zeros_like(heat)
    kept = torch.zeros_like(heat, dtype=torch.bool)
    near = kept
    for _ in range(rounds):
        left = torch.where(near, zero, heat)
        kept = kept | ((left == _pooled_max(left, radius)) & ~near)
        near = _pooled_max(kept.to(heat.dtype), radius) > 0
    return torch.where(kept, heat, zero)


def top_keypoints(
    heat: Float[Tensor, "batch height width"], count: int, border: int
) -> tuple[Float[Tensor, "batch keypoint 2"], Float[Tensor, "batch keypoint"]]:
    """The `count` highest pixels (fewer in smaller images), best first, none within `border` of the image's border.

    Keypoints are (x, y) pixels, centres at integers; a score of 0 or less marks padding.
    """
    batch, height, width = heat.shape
    inside = torch.zeros_like(heat, dtype=torch.bool)
    inside[:, border : height - border, border : width - border] = True
    flat = torch.where(inside, heat, torch.zeros_like(heat)).reshape(batch, -1)
    scores, place = flat.topk(min(count, flat.shape[1]), 1)
    return torch.stack([place % width, place.div(width, rounding_mode="floor")], -1).to(heat.dtype), scores


def sample_descriptors(
    coarse: Float[Tensor, "batch feature rows columns"], keypoints: Float[Tensor, "batch keypoint 2"]
) -> Float[Tensor, "batch keypoint feature"]:
    """Bilinear samples of the coarse map at pixels, of unit length.

    The published sampling puts the first cell's centre at pixel 3.5, which is right, but the last of n at 8 n - 1
    instead of 8 n - 4.5. We keep it, because the published matchers were trained with it.
    """
    rows, columns = coarse.shape[-2:]
    first = (CELL - 1) / 2
    last = CELL * coarse.new_tensor([columns, rows]) - 1
    grid = (keypoints - first) / (last - first) * 2 - 1
    sampled = F.grid_sample(coarse, grid[:, None], mode="bilinear", align_corners=True)
    return F.normalize(sampled[:, :, 0].transpose(1, 2), dim=-1)


class SuperPoint(nn.Module):
    """A VGG-like encoder to an eighth of the size, a detector head (64 positions + "none") and a descriptor head."""

    def __init__(self, nms_radius: int = 4, border: int = 4, max_keypoints: int = 4096):
        super().__init__()
        self.nms_radius, self.border, self.max_keypoints = nms_radius, border, max_keypoints
        self.conv1a = nn.Conv2d(1, 64, 3, padding=1)
        self.conv1b = nn.Conv2d(64, 64, 3, padding=1)
        self.conv2a = nn.Conv2d(64, 64, 3, padding=1)
        self.conv2b = nn.Conv2d(64, 64, 3, padding=1)
        self.conv3a = nn.Conv2d(64, 128, 3, padding=1)
        self.conv3b = nn.Conv2d(128, 128, 3, padding=1)
        self.conv4a = nn.Conv2d(128, 128, 3, padding=1)
        self.conv4b = nn.Conv2d(128, 128, 3, padding=1)
        self.convPa = nn.Conv2d(128, 256, 3, padding=1)
        self.convPb = nn.Conv2d(256, CELL * CELL + 1, 1)
        self.convDa = nn.Conv2d(128, 256, 3, padding=1)
        self.convDb = nn.Conv2d(256, 256, 1)

    def dense(
        self, image: Float[Tensor, "batch 1 height width"]
    ) -> tuple[Float[Tensor, "batch cut_height cut_width"], Float[Tensor, "batch 256 rows columns"]]:
        """Probability of a keypoint per pixel (sizes cut to multiples of 8), and one unit descriptor per cell."""
        x = F.relu(self.conv1b(F.relu(self.conv1a(image))))
        x = F.relu(self.conv2b(F.relu(self.conv2a(F.max_pool2d(x, 2)))))
        x = F.relu(self.conv3b(F.relu(self.conv3a(F.max_pool2d(x, 2)))))
        x = F.relu(self.conv4b(F.relu(self.conv4a(F.max_pool2d(x, 2)))))
        places = self.convPb(F.relu(self.convPa(x))).softmax(1)[:, :-1]
        return F.pixel_shuffle(places, CELL)[:, 0], F.normalize(self.convDb(F.relu(self.convDa(x))), dim=1)

    def forward(
        self, image: Float[Tensor, "batch 1 height width"]
    ) -> tuple[Float[Tensor, "batch keypoint 2"], Float[Tensor, "batch keypoint 256"], Float[Tensor, "batch keypoint"]]:
        """Keypoints (x, y) in pixels, unit descriptors and scores, best first, of grey pictures in [0, 1].

        The number of keypoints is fixed by the picture's size, for export; those below a threshold, the caller drops.
        """
        heat, coarse = self.dense(image)
        keypoints, scores = top_keypoints(suppress(heat, self.nms_radius), self.max_keypoints, self.border)
        return keypoints, sample_descriptors(coarse, keypoints), scores
