"""A convolutional autoencoder of motion windows, in whose latent space motions are compared (Guo et al. 2020)."""

from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from wearcap.models.layers import Normalizer


class MotionAutoencoder(nn.Module):
    """Strided convolutions over time, as in Guo et al.'s movement encoder and decoder, around one vector per window.

    What the convolutions leave of the time axis is flattened, not averaged, so that the vector keeps the order of
    what happened. Each of its `latent` dimensions has mean 0 and variance 1 over the training windows (a batch
    normalisation without parameters of its own): distances mean the same after every training. 64 dimensions,
    because the covariance of a few thousand overlapping windows has to be estimated in them: 512 as in the protocol
    would want tens of thousands.
    """

    def __init__(
        self, size: int, frames: int = 80, channels: tuple[int, ...] | list[int] = (128, 192, 192), latent: int = 64
    ):  # fmt: skip
        """`size` features per frame; every convolution halves the `frames`. Raises ValueError where it cannot."""
        super().__init__()
        if frames % 2 ** len(channels):
            raise ValueError(f"{frames} frames cannot be halved {len(channels)} times")
        self.size, self.frames, self.latent = size, frames, latent
        self.normalizer = Normalizer(size)
        short, widths = frames // 2 ** len(channels), (size, *channels)
        down = [(nn.Conv1d(a, b, 4, 2, 1), nn.LeakyReLU(0.2)) for a, b in pairwise(widths)]
        up = [
            (nn.LeakyReLU(0.2), nn.ConvTranspose1d(b, a, 4, 2, 1)) for a, b in reversed([*pairwise(widths)])
        ]
        self.encoder = nn.Sequential(
            *(layer for block in down for layer in block), nn.Flatten(),
            nn.Linear(short * channels[-1], latent), nn.BatchNorm1d(latent, momentum=0.01, affine=False),
        )  # fmt: skip
        self.decoder = nn.Sequential(
            nn.Linear(latent, short * channels[-1]), nn.Unflatten(1, (channels[-1], short)),
            *(layer for block in up for layer in block),
        )  # fmt: skip

    def encode(self, features: Float[Tensor, "window frame feature"]) -> Float[Tensor, "window latent"]:
        """One vector per window; features as they are, not normalised."""
        return self.encoder(self.normalizer(features).transpose(1, 2))

    def decode(self, latent: Float[Tensor, "window latent"]) -> Float[Tensor, "window frame feature"]:
        """Normalised features of every window."""
        return self.decoder(latent).transpose(1, 2)

    def forward(
        self, features: Float[Tensor, "window frame feature"]
    ) -> Float[Tensor, "window frame feature"]:
        """The window again, in normalised features."""
        return self.decode(self.encode(features))
