"""Training of our small image encoder to locate the wearer's own limbs in a head camera's frame."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from wearcap.metrics.detection import average_precision
from wearcap.models.image_encoder import EgoViewEncoder, letterboxed
from wearcap.models.layers import Normalizer
from wearcap.systems.hmd2.egoview_frames import HANDS, POINTS, EgoFrame, EgoFrames, half_mirrored, relit, turned
from wearcap.training.base import Optimization, Training

LEAST_SPREAD_M = 0.02


class EgoView(Training):
    """Linear heads on the embedding predict which of `POINTS` are in the image, and their positions.

    The loss is the binary cross-entropy of visibility plus the Huber loss of visible points' positions in standard
    deviations. The heads are linear so that the embedding itself represents the positions. `turn_deg`: the
    `deviation_deg` of `egoview_frames.turned`.
    """

    def __init__(
        self,
        net: EgoViewEncoder,
        optimization: Optimization,
        dropout: float = 0.0,
        augment: bool = True,
        turn_deg: float = 6.0,
    ):
        super().__init__(optimization)
        self.net, self.heads = net, nn.Linear(net.size, 4 * len(POINTS))
        self.normalizer = Normalizer(3 * len(POINTS))
        self.dropout, self.augment, self.turn_deg = nn.Dropout(dropout), augment, turn_deg
        self._validated: list[tuple[Tensor, Tensor, EgoFrame]] = []

    def set_statistics(self, dataset: EgoFrames) -> None:
        """Set mean and deviation of every point's position over the frames where it is visible."""
        weight = dataset.visible.double()[..., None]
        count = weight.sum(0).clamp_min(1)
        mean = (weight * dataset.point_cam).sum(0) / count
        spread = ((weight * (dataset.point_cam - mean) ** 2).sum(0) / count).sqrt().clamp_min(LEAST_SPREAD_M)
        self.normalizer.set(mean.flatten().float(), spread.flatten().float())

    def forward(
        self, pictures: Float[Tensor, "batch 3 height width"]
    ) -> tuple[Float[Tensor, "batch point"], Float[Tensor, "batch point 3"]]:
        """Logits of visibility, and positions in the camera's axes (m)."""
        logits, places = self.heads(self.dropout(self.net(pictures))).split([len(POINTS), 3 * len(POINTS)], -1)
        return logits, self.normalizer.inverse(places).unflatten(-1, (len(POINTS), 3))

    def pictures(self, batch: EgoFrame) -> Float[Tensor, "batch 3 height width"]:
        """The batch's images, letterboxed and normalised for the network."""
        return letterboxed(batch.picture, self.net.width, self.net.height, self.net.mean, self.net.std)

    def _intrinsics(self, batch: EgoFrame) -> Float[Tensor, "batch 4"]:
        """Intrinsics of the letterboxed images."""
        height, width = batch.picture.shape[1:3]
        scale = min(self.net.width / width, self.net.height / height)
        margin = (torch.tensor([self.net.width, self.net.height]) - scale * torch.tensor([width, height])) / 2
        centre = scale * (batch.intrinsics[:, 2:] + 0.5) - 0.5 + margin.to(batch.intrinsics)
        return torch.cat([scale * batch.intrinsics[:, :2], centre], -1)

    def loss(
        self,
        pictures: Float[Tensor, "batch 3 height width"],
        point_cam: Float[Tensor, "batch point 3"],
        visible: Bool[Tensor, "batch point"],
    ) -> Tensor:
        logits, places = self(pictures)
        spread = self.normalizer.scale.unflatten(-1, (len(POINTS), 3))
        miss = F.smooth_l1_loss(places / spread, point_cam / spread, reduction="none").mean(-1)
        seen = F.binary_cross_entropy_with_logits(logits, visible.to(logits.dtype))
        return seen + (miss * visible).sum() / visible.sum().clamp_min(1)

    def measure(self, batch: EgoFrame) -> dict[str, Tensor]:
        """The loss, in training of augmented images; in validation predictions are kept for the scores."""
        varied = self.pictures(batch), batch.point_cam, batch.visible
        if not self.training:
            self._validated.append((*self(varied[0]), batch))
        elif self.augment:
            pictures, *points = turned(varied[0], self._intrinsics(batch), *varied[1:], self.turn_deg)
            varied = half_mirrored(relit(pictures), *points)
        return {"loss": self.loss(*varied)}

    def on_validation_epoch_end(self) -> None:
        logits, places = (torch.cat([part[k] for part in self._validated]) for k in range(2))
        truth = EgoFrame(*(torch.cat(field) for field in zip(*(part[2] for part in self._validated))))
        mean = self.normalizer.mean.unflatten(-1, (len(POINTS), 3)).expand_as(places)
        for name, value in view_scores(logits.sigmoid(), places, mean, truth.point_cam, truth.visible).items():
            self.log(f"val/{name}", value)
        self._validated.clear()


def view_scores(
    prob: Float[Tensor, "frame point"],
    places: Float[Tensor, "frame point 3"],
    mean_places: Float[Tensor, "frame point 3"],
    point_cam: Float[Tensor, "frame point 3"],
    visible: Bool[Tensor, "frame point"],
) -> dict[str, float]:
    """Average precision of detecting the hands, mean position error (cm) of visible hands, and that of all points.

    Each is averaged over sides or points. "hand_share" and the "_of_mean" errors are those of a predictor that always
    outputs the training split's mean.
    """
    left, right = (POINTS.index(name) for name in HANDS)
    errors = {"": places, "_of_mean": mean_places}
    scores = {
        "hand_average_precision": _mean([average_precision(prob[:, k], visible[:, k]) for k in (left, right)]),
        "hand_share": float(visible[:, [left, right]].double().mean()),
    }
    for suffix, guess in errors.items():
        error = 100 * (guess - point_cam).norm(dim=-1)
        by_point = [float(error[visible[:, k], k].mean()) for k in range(len(POINTS))]
        scores[f"hand_error_cm{suffix}"] = _mean([by_point[left], by_point[right]])
        scores[f"point_error_cm{suffix}"] = _mean(by_point)
    return scores


def _mean(values: list[float]) -> float:
    """Mean of the values that are not NaN."""
    return float(torch.tensor(values).nanmean())
