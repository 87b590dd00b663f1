"""Linear triangulation from any number of rays, bent or not."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.numerics import inverse_cholesky_3x3


def triangulate(
    origins: Float[Tensor, "*batch n 3"],
    directions: Float[Tensor, "*batch n 3"],
    weights: Float[Tensor, "*batch n"] | None = None,
) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
    """The points with the least sum of squared distances to their rays.

    origins and unit directions, as `RefractiveCamera.cast_rays` returns them (the rays lie in the water, so that
    refraction needs no further thought); weights: zero for a ray that does not exist. Returns points and valid: False
    with fewer than two rays, or with parallel ones, where the point is the (weighted) mean of the origins.
    Raises ValueError for shapes that differ.
    """
    if origins.shape != directions.shape or origins.shape[-1:] != (3,):
        raise ValueError(
            f"origins {tuple(origins.shape)} and directions {tuple(directions.shape)} must both be (*B, n, 3)"
        )
    if weights is None:
        weights = origins.new_ones(origins.shape[:-1])
    total = weights.sum(dim=-1)
    enough = (weights > 0.0).sum(dim=-1) >= 2
    share = (weights / torch.where(total > 0.0, total, 1.0)[..., None])[..., None]
    mean = (share * origins).sum(dim=-2)
    local = origins - mean[..., None, :]
    identity = torch.eye(3, dtype=origins.dtype, device=origins.device)
    normal = identity * share.sum(dim=-2)[..., None] - (share * directions).mT @ directions
    along = (local * directions).sum(dim=-1, keepdim=True)
    rhs = (share * (local - along * directions)).sum(dim=-2)
    # trace(normal) = sum of shares * 2; parallel rays make one eigenvalue vanish.
    determinant = torch.linalg.det(normal)
    valid = enough & (determinant > 1e4 * torch.finfo(origins.dtype).eps)
    safe = torch.where(valid[..., None, None], normal, identity)
    factor = inverse_cholesky_3x3(safe)
    solution = (factor.mT @ (factor @ rhs[..., None]))[..., 0]
    return mean + torch.where(valid[..., None], solution, 0.0), valid


def triangulation_angle(
    directions: Float[Tensor, "*batch n 3"], present: Bool[Tensor, "*batch n"]
) -> Float[Tensor, "*batch"]:
    """Largest angle, radians, between any two of the unit directions that are `present`."""
    cosine = directions @ directions.mT
    both = present[..., :, None] & present[..., None, :]
    smallest = torch.where(both, cosine, 1.0).flatten(-2).amin(dim=-1)
    return smallest.clamp(-1.0, 1.0).acos()
