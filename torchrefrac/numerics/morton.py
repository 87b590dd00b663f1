"""Places on a curve that fills space: points with near places are near each other."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

BITS = 16


def morton_code(points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Morton (Z-order) codes of points in their bounding cube."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.long, device=points.device)
    finite = torch.where(points.isfinite(), points, 0.0)
    low = finite.amin(dim=0)
    side = (finite.amax(dim=0) - low).amax().clamp(min=torch.finfo(points.dtype).tiny)
    grid = ((finite - low) / side * (2**BITS - 1)).long()
    code = torch.zeros_like(grid[:, 0])
    for bit in range(BITS):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
