"""How exact depths are, in the words of hydrographic surveys: the orders of IHO's S-44 (6th edition, 2020, table 1)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.dense.tiles import Tile

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


class BedStatistics:
    """What is known of the bed, gathered from the tiles of a raster."""

    def __init__(self, cell_size: float) -> None:
        self._cell_size = cell_size
        self._depth = [torch.zeros(0)]
        self._sigma = [torch.zeros(0)]

    def add(self, tile: Tile) -> None:
        """The cells of a tile below the water."""
        raster = tile.raster
        bed = tile.inner(raster.valid & (raster.height < 0.0))
        self._depth.append(tile.inner(raster.depth)[bed].float())
        self._sigma.append(tile.inner(raster.sigma)[bed].float())

    def metrics(self, unit: str) -> dict[str, float]:
        """With UNIT the length unit: bed_area_UNIT2, depth_median_UNIT and depth_99_percent_UNIT (so much of it is not
        deeper), bed_sigma_median_UNIT, and s44_NAME_percent, the share that each order of S-44 allows; none without a
        bed."""
        depth, sigma = torch.cat(self._depth), torch.cat(self._sigma)
        if not len(depth):
            return {}
        known = {
            f"bed_area_{unit}2": len(depth) * self._cell_size**2,
            f"depth_median_{unit}": float(depth.median()),
            f"depth_99_percent_{unit}": float(depth.kthvalue(max(1, int(0.99 * len(depth)))).values),
            f"bed_sigma_median_{unit}": float(sigma.median()),
        }
        shares = order_shares(depth, sigma, unit)
        return known | {f"s44_{name}_percent": round(100.0 * share, 2) for name, share in shares.items()}


def order_shares(depth: Float[Tensor, " n"], sigma: Float[Tensor, " n"], length_unit: str) -> dict[str, float]:
    """By the name of each order the share (0 to 1) of n cells of the bed whose uncertainty it allows; empty where there
    are none, or the unit of length is not known in metres."""
    if length_unit not in IN_METRES or not len(depth):
        return {}
    factor = IN_METRES[length_unit]
    tvu = vertical_uncertainty(factor * sigma)
    return {order.name: float((tvu <= order.most(factor * depth)).double().mean()) for order in ORDERS}
