"""A convolutional autoencoder of motion windows, whose latent space FID and Diversity use (Guo et al. 2020)."""

from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from wearcap.models.layers import Normalizer


class MotionAutoencoder(nn.Module):
    """Strided convolutions over time, as in Guo et al.'s movement encoder and decoder, around one vector per window.

    The remaining time axis after the convolutions is flattened, not averaged, so that the vector keeps the temporal
    order. Each of the `latent` dimensions has mean 0 and variance 1 over the training windows (batch normalisation
    without affine parameters), so that distances are comparable between trainings. We use 64 dimensions, in which the
    covariance can be estimated from a few thousand overlapping windows; the protocol's 512 need tens of thousands.
    """

    def __init__(
        self, size: int, frames: int = 80, channels: tuple[int, ...] | list[int] = (128, 192, 192), latent: int = 64
    ):
        """`size` features per frame; every convolution halves `frames`. Raises ValueError if they are not divisible."""
        super().__init__()
        if frames % 2 ** len(channels):
            raise ValueError(f"{frames} frames cannot be halved {len(channels)} times")
        self.size, self.frames, self.latent = size, frames, latent
        self.normalizer = Normalizer(size)
        short, widths = frames // 2 ** len(channels), (size, *channels)
        down = [(nn.Conv1d(a, b, 4, 2, 1), nn.LeakyReLU(0.2)) for a, b in pairwise(widths)]
        up = [(nn.LeakyReLU(0.2), nn.ConvTranspose1d(b, a, 4, 2, 1)) for a, b in reversed([*pairwise(widths)])]
        self.encoder = nn.Sequential(
            *(layer for block in down for layer in block),
            nn.Flatten(),
            nn.Linear(short * channels[-1], latent),
            nn.BatchNorm1d(latent, momentum=0.01, affine=False),
        )
        self.decoder = nn.Sequential(
            nn.Linear(latent, short * channels[-1]),
            nn.Unflatten(1, (channels[-1], short)),
            *(layer for block in up for layer in block),
        )

    def encode(self, features: Float[Tensor, "window frame feature"]) -> Float[Tensor, "window latent"]:
        """Latent vector of every window, from features that are not normalised."""
        return self.encoder(self.normalizer(features).transpose(1, 2))

    def decode(self, latent: Float[Tensor, "window latent"]) -> Float[Tensor, "window frame feature"]:
        """Normalised features of every window."""
        return self.decoder(latent).transpose(1, 2)

    def forward(self, features: Float[Tensor, "window frame feature"]) -> Float[Tensor, "window frame feature"]:
        """Reconstructed windows in normalised features."""
        return self.decode(self.encode(features))
