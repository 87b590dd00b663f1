"""The paper's quartic for the refrax ratio, solved as an eigenvalue problem: the oracle of the iterations."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry.triples import Part
from torchrefrac.numerics import real_roots


def refrax_ratio_companion(height: Part, depth: Part, distance_sq: Part, index_ratio: Part) -> Float[Tensor, "*batch"]:
    """Refrax ratio from Eq. 4 of Chang & Chen (ICCV 2011), with +h^2 as its constant term.

    Solved for mu = 1/lambda: h^2 mu^4 - 2 h^2 mu^3 + (N a^2 + h^2 - d^2/n^2) mu^2 - 2 N a^2 mu + N a^2 = 0 with N = 1 -
    1/n^2 and D = a^2. Its leading coefficient never vanishes, whereas that of Eq. 4 does at nadir and at index ratio 1.
    Squaring Snell's law added roots: of those with mu >= 1 the one that fulfils the unsquared law best is taken.
    """
    ratio_d = depth / height
    n_a_sq = (1.0 - index_ratio.square().reciprocal()) * distance_sq / height.square()
    middle = n_a_sq + 1.0 - (ratio_d / index_ratio).square()
    one = torch.ones_like(middle)
    coefficients = torch.stack((one, -2.0 * one, middle, -2.0 * n_a_sq, n_a_sq), dim=-1)
    mu, is_real = real_roots(coefficients, tolerance=1e3 * torch.finfo(middle.dtype).eps ** 0.5)
    candidate = mu.clamp(min=1.0).reciprocal()
    violation = _snell_violation(candidate, ratio_d, distance_sq / height.square(), index_ratio)
    possible = is_real & (mu >= 1.0 - 1e-6)
    violation = torch.where(possible, violation.abs(), torch.full_like(violation, torch.inf))
    best = violation.argmin(dim=-1, keepdim=True)
    return candidate.gather(-1, best)[..., 0]


def _snell_violation(
    ratio: Float[Tensor, "*#batch 4"], depth: Part, distance_sq: Part, index_ratio: Part
) -> Float[Tensor, "*batch 4"]:
    """sin(air) - n sin(water), times both slant lengths over the distance; height 1."""
    depth, distance_sq, index_ratio = depth[..., None], distance_sq[..., None], index_ratio[..., None]
    rest = 1.0 - ratio
    in_water = (rest.square() * distance_sq + depth.square()).sqrt()
    in_air = (ratio.square() * distance_sq + 1.0).sqrt()
    return ratio * in_water - index_ratio * rest * in_air
