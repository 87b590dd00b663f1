"""How exact depths are, in the words of hydrographic surveys: the orders of IHO's S-44 (6th edition, 2020, table 1)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

NORMAL_95 = 1.959964
"""Standard deviations within which a normal error lies with a probability of 95 %."""


@dataclass(frozen=True)
class Order:
    """Of depth d in metres the total vertical uncertainty at 95 % may be sqrt(a^2 + (b d)^2)."""

    name: str
    a: float
    b: float

    def most(self, depth: Float[Tensor, "*cells"]) -> Float[Tensor, "*cells"]:
        """The uncertainty that is allowed at depths in metres."""
        return torch.hypot(torch.full_like(depth, self.a), self.b * depth)


ORDERS = (
    Order("exclusive", 0.15, 0.0075),
    Order("special", 0.25, 0.0075),
    Order("1", 0.5, 0.013),
    Order("2", 1.0, 0.023),
)
"""From the strictest on; 1a and 1b allow the same."""
IN_METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "ft": 0.3048}


def vertical_uncertainty(sigma: Float[Tensor, "*cells"]) -> Float[Tensor, "*cells"]:
    """Total vertical uncertainty at 95 % of heights with these standard deviations."""
    return NORMAL_95 * sigma


def order_shares(depth: Float[Tensor, " n"], sigma: Float[Tensor, " n"], length_unit: str) -> dict[str, float]:
    """By the name of each order the share (0 to 1) of n cells of the bed whose uncertainty it allows; empty where there
    are none, or the unit of length is not known in metres."""
    if length_unit not in IN_METRES or not len(depth):
        return {}
    factor = IN_METRES[length_unit]
    tvu = vertical_uncertainty(factor * sigma)
    return {order.name: float((tvu <= order.most(factor * depth)).double().mean()) for order in ORDERS}
