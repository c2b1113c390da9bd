"""MocapEvery's motion manifold: a convolutional autoencoder of contacts, root and joint rotations (§3.4, D.4)."""

from jaxtyping import Float
from torch import Tensor, nn

from wearcap.models.layers import Normalizer


class MotionManifold(nn.Module):
    """Strided convolutions over time and a transposed decoder (the paper: 3 layers, width 25, stride 2, 256 channels).

    Frames have `size` features: contact of both feet, root translation, 6D rotations (137 with 22 joints). A window's
    number of frames must be a multiple of `multiple`.
    """

    def __init__(self, size: int, channels: int = 256, width: int = 25, layers: int = 3):
        super().__init__()
        self.size, self.halvings = size, layers
        self.normalizer = Normalizer(size)
        half = width // 2
        down: list[nn.Module] = []
        up: list[nn.Module] = []
        for layer in range(layers):
            inner, outer = channels, size if layer == 0 else channels
            down += [nn.Conv1d(outer, inner, width, 2, half), nn.LeakyReLU(0.2)]
            up = [nn.ConvTranspose1d(inner, outer, width, 2, half, output_padding=1), *up]
            if layer < layers - 1:
                up = [nn.LeakyReLU(0.2), *up]
        self.encoder, self.decoder = nn.Sequential(*down[:-1]), nn.Sequential(*up)

    @property
    def multiple(self) -> int:
        """Factor that a window's number of frames must be divisible by."""
        return 2**self.halvings

    def encode(self, motion: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch channel short"]:
        """Latents z of motions (raw features)."""
        return self.encoder(self.normalizer(motion).transpose(1, 2))

    def decode(self, latent: Float[Tensor, "batch channel short"]) -> Float[Tensor, "batch time feature"]:
        """Motions (raw features) of latents."""
        return self.normalizer.inverse(self.decoder(latent).transpose(1, 2))

    def forward(self, motion: Float[Tensor, "batch time feature"]) -> Float[Tensor, "batch time feature"]:
        return self.decode(self.encode(motion))
