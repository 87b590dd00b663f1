"""Observations: what was seen where."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Observations:
    """Points `point` seen in views `view` at `pixels`, each point at most once in a view.

    Those of one point are its track. Where they are part of a `Scene`, `point` ascends. weight: of each squared
    residual, by default 1.
    """

    view: Int[Tensor, " k"]
    point: Int[Tensor, " k"]
    pixels: Float[Tensor, "k 2"]
    weight: Float[Tensor, " k"] | None = None

    @classmethod
    def none(cls) -> "Observations":
        """Nothing was seen."""
        index = torch.zeros(0, dtype=torch.long)
        return cls(index, index, torch.zeros(0, 2, dtype=torch.float64))

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, rows: Shaped[Tensor, " j"] | slice) -> "Observations":
        """Some of them, by a mask or by their numbers."""
        weight = None if self.weight is None else self.weight[rows]
        return Observations(self.view[rows], self.point[rows], self.pixels[rows], weight)

    @property
    def weights(self) -> Float[Tensor, " k"]:
        """weight, or ones."""
        return torch.ones_like(self.pixels[:, 0]) if self.weight is None else self.weight

    def detached(self) -> "Observations":
        """The same without a graph."""
        weight = None if self.weight is None else self.weight.detach()
        return replace(self, pixels=self.pixels.detach(), weight=weight)
