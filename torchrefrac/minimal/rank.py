"""Whether a least-squares problem that was reduced by QR determines its unknowns."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

ROUNDING = 64.0
"""Multiple of the machine epsilon below which a remainder counts as rounding of the column it is left of."""


def determines(triangle: Float[Tensor, "*batch rows columns"], head: int, tail: int) -> Bool[Tensor, "*batch"]:
    """Whether R, of at least head + tail columns, fixes both groups of unknowns.

    Each of the first `head` columns must be independent of those before it, and one of the `tail` columns that follow
    must be independent of the head. Columns are compared with their own length, so that their units do not matter.
    """
    square = triangle[..., : head + tail].square()
    rest = square[..., head:, head:].sum(dim=-2)
    own = torch.cat((square[..., :head, :head].diagonal(dim1=-2, dim2=-1), rest), dim=-1)
    independent = own > (ROUNDING * torch.finfo(triangle.dtype).eps) ** 2 * square.sum(dim=-2)
    return independent[..., :head].all(dim=-1) & independent[..., head:].any(dim=-1)
