"""Distribution metrics of motion sets in the latent space of a motion autoencoder (Guo et al. 2020): FID, diversity."""

import torch
from jaxtyping import Float
from torch import Tensor

from wearcap.errors import WearcapError

DIVERSITY_SAMPLES = 300
"""Size of each of the two subsets between which diversity is measured."""


def frechet_distance(
    latent: Float[Tensor, "sample feature"], latent_true: Float[Tensor, "other feature"]
) -> Float[Tensor, ""]:
    """FID: Fréchet distance between Gaussians fitted to both sets, ‖μ−μ'‖² + tr(C + C' − 2(CC')^½), in float64.

    The trace of the last root is the sum of the singular values of C^½ C'^½, which avoids roots of non-symmetric
    matrices and is valid for rank-deficient covariances. Raises WearcapError for sets of fewer than two samples and for
    values that are not finite.
    """
    fitted = []
    for each in (latent, latent_true):
        if len(each) < 2 or not each.isfinite().all():
            raise WearcapError(f"no distribution in {len(each)} samples", expected="two at least, all finite")
        values, vectors = torch.linalg.eigh(torch.cov(each.double().T).reshape(each.shape[1], -1))
        # Mean and symmetric square root of the (unbiased) covariance.
        fitted.append((each.double().mean(0), (vectors * values.clamp(min=0).sqrt()) @ vectors.T))
    (mean, root), (mean_true, root_true) = fitted
    cross = torch.linalg.svdvals(root @ root_true).sum()
    spread = root.square().sum() + root_true.square().sum()
    return ((mean - mean_true).square().sum() + spread - 2 * cross).clamp(min=0)


def diversity(
    latent: Float[Tensor, "sample feature"], size: int = DIVERSITY_SAMPLES, seed: int = 0
) -> Float[Tensor, ""]:
    """Mean distance between paired samples of two disjoint random subsets of `size` samples each.

    The subsets depend on seed and number of samples only, so sets of equal size use the same indices. Raises
    WearcapError for fewer than 2 · `size` samples.
    """
    if len(latent) < 2 * size:
        raise WearcapError(f"{len(latent)} samples for two subsets of {size}", expected=f"{2 * size} at least")
    order = torch.randperm(len(latent), generator=torch.Generator().manual_seed(seed))
    first, second = latent[order[: 2 * size].to(latent.device)].double().chunk(2)
    return (first - second).norm(dim=-1).mean()
