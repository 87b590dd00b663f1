"""How far numbers scatter, whatever some of them do."""

import math

from jaxtyping import Float
from torch import Tensor

MEDIAN_LENGTH = math.sqrt(2.0 * math.log(2.0))
"""Of a vector whose two components have a normal distribution of variance one (Rayleigh's law)."""


def typical_deviation(length: Float[Tensor, " k"]) -> float:
    """Standard deviation of a component of most of some vectors of two normal components, from the median of their
    lengths, of which there must be one at least."""
    return float(length.median()) / MEDIAN_LENGTH
