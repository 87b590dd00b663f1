"""What is said of all points of a cloud that is corrected part by part."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.correction.points import Correction


@dataclass(frozen=True)
class Totals:
    """Numbers of points, and sums over those that were corrected, which add up over parts.

    below: how many points lie below the water; without_water: where nobody knows of any. deepest: depth of the deepest
    that was corrected; lowest: least height above the water of any point, negative below it.
    """

    points: int = 0
    below: int = 0
    without_water: int = 0
    corrected: int = 0
    views: int = 0
    incidence: float = 0.0
    depth: float = 0.0
    depth_sq: float = 0.0
    apparent_depth: float = 0.0
    misfit_sq: float = 0.0
    sigma_sq: float = 0.0
    deepest: float = 0.0
    lowest: float = math.inf

    @classmethod
    def of(cls, part: Correction, given: Float[Tensor, "n 3"], wet: Bool[Tensor, " n"]) -> "Totals":
        """Of one part, from its points as they were given, and where there is water."""
        which = part.corrected
        depth, sigma = part.depth[which], part.sigma[which]
        above = (given[:, 2] - part.level)[wet]
        return cls(
            points=len(part),
            below=int(part.below.sum()),
            without_water=len(part) - int(wet.sum()),
            corrected=int(which.sum()),
            views=int(part.views.sum()),
            incidence=float(part.incidence[which].sum()),
            depth=float(depth.sum()),
            depth_sq=float(depth.square().sum()),
            apparent_depth=float(part.apparent_depth[which].sum()),
            misfit_sq=float(part.misfit[which].square().sum()),
            sigma_sq=float(torch.where(sigma.isfinite(), sigma, 0.0).square().sum()),
            deepest=float(depth.max()) if len(depth) else 0.0,
            lowest=float(above.min()) if len(above) else math.inf,
        )

    def __add__(self, other: "Totals") -> "Totals":
        both: dict[str, Any] = {name: value + getattr(other, name) for name, value in asdict(self).items()}
        ends: dict[str, Any] = {"deepest": max(self.deepest, other.deepest), "lowest": min(self.lowest, other.lowest)}
        return Totals(**(both | ends))
