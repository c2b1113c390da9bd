"""NetVLAD (Arandjelović et al. 2016): a global image descriptor, similar for images of the same place.

Modules carry the names of pytorch-NetVlad's checkpoints (`encoder.N`, `pool.conv`, `pool.centroids`) and of
Patch-NetVLAD's whitening (`WPCA.0`).
"""

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

# VGG16 (Simonyan & Zisserman 2015) up to conv5_3: channels of each convolution, 0 for a pooling.
_VGG16 = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)


class VladPooling(nn.Module):
    """Residuals to soft-assigned centroids, summed over the picture (eq. 4), normalised within and over centroids."""

    def __init__(self, clusters: int, size: int, bias: bool):
        super().__init__()
        self.conv = nn.Conv2d(size, clusters, 1, bias=bias)
        self.centroids = nn.Parameter(self.conv.weight.detach()[:, :, 0, 0].clone())

    def forward(self, x: Float[Tensor, "batch feature height width"]) -> Float[Tensor, "batch vlad"]:
        x = F.normalize(x, dim=1)
        share = self.conv(x).softmax(1).flatten(2)
        # Σ_i a_ik (x_i - c_k) = Σ_i a_ik x_i - (Σ_i a_ik) c_k, without a tensor of all residuals.
        vlad = share @ x.flatten(2).transpose(1, 2) - share.sum(-1, keepdim=True) * self.centroids
        return F.normalize(F.normalize(vlad, dim=2).flatten(1), dim=1)


class NetVLAD(nn.Module):
    """VGG16, NetVLAD over `clusters` centroids and, if `whitened` > 0, PCA whitening to so many values."""

    mean: Tensor
    scale: Tensor

    def __init__(self, clusters: int = 64, whitened: int = 0, bias: bool = False):
        super().__init__()
        layers, channels = [], 3
        for width in _VGG16:
            if width:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
            else:
                layers.append(nn.MaxPool2d(2))
        self.encoder = nn.Sequential(*layers[:-1])  # numbered as in torchvision, without the last ReLU
        self.pool = VladPooling(clusters, 512, bias)
        self.WPCA = nn.Sequential(nn.Conv2d(clusters * 512, whitened, 1)) if whitened else None
        # ImageNet's colours, in which VGG16 was trained.
        for name, values in (("mean", (0.485, 0.456, 0.406)), ("scale", (0.229, 0.224, 0.225))):
            self.register_buffer(name, self.pool.centroids.new_tensor(values)[:, None, None], persistent=False)

    def forward(self, image: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch feature"]:
        """Unit descriptors of RGB images in [0, 1]."""
        vlad = self.pool(self.encoder((image - self.mean) / self.scale))
        if self.WPCA is None:
            return vlad
        return F.normalize(self.WPCA(vlad[:, :, None, None])[:, :, 0, 0], dim=1)
