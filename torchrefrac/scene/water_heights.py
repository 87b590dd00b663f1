"""How high the water stands at any place, where it is no plane z = 0."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry.triangle_mesh import TriangleMesh


class WaterHeights(Protocol):
    """A surface of water over x and y."""

    def at(self, places: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
        """Heights at some places, and where there is any water; elsewhere they are zero."""
        ...


@dataclass(frozen=True)
class LevelWater:
    """Water of one height everywhere."""

    height: float

    def at(self, places: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
        everywhere = torch.ones_like(places[:, 0], dtype=torch.bool)
        return torch.full_like(places[:, 0], self.height), everywhere


@dataclass(frozen=True, eq=False)
class GridWater:
    """Heights at the centres of cells, row 0 in the north; bilinear between four known ones, else that of the cell.

    known: where there is water. x_west, y_north: the outer corner of the first cell; cell: its width and its height.
    """

    height: Float[Tensor, "rows columns"]
    known: Bool[Tensor, "rows columns"]
    x_west: float
    y_north: float
    cell: tuple[float, float]

    def at(self, places: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
        rows, columns = self.height.shape
        column = (places[:, 0] - self.x_west) / self.cell[0]
        row = (self.y_north - places[:, 1]) / self.cell[1]
        inside = (column >= 0.0) & (column <= columns) & (row >= 0.0) & (row <= rows)
        column, row = torch.where(inside, column, 0.0), torch.where(inside, row, 0.0)
        i, j = row.long().clamp(max=rows - 1), column.long().clamp(max=columns - 1)
        x, y = (column - 0.5).clamp(0.0, columns - 1.0), (row - 0.5).clamp(0.0, rows - 1.0)
        left, top = x.long().clamp(max=max(columns - 2, 0)), y.long().clamp(max=max(rows - 2, 0))
        right, below = (left + 1).clamp(max=columns - 1), (top + 1).clamp(max=rows - 1)
        u, v = x - left, y - top
        corners = ((top, left), (top, right), (below, left), (below, right))
        shares = ((1.0 - v) * (1.0 - u), (1.0 - v) * u, v * (1.0 - u), v * u)
        four = list(zip(shares, corners, strict=True))
        mixed = torch.stack([share * self.height[at] for share, at in four]).sum(dim=0)
        all_known = torch.stack([self.known[at] | (share == 0.0) for share, at in four]).all(dim=0)
        there = inside & self.known[i, j]
        return torch.where(there, torch.where(all_known, mixed, self.height[i, j]), 0.0), there


@dataclass(frozen=True, eq=False)
class MeshWater:
    """Triangles between points of known height; there is no water beyond them."""

    mesh: TriangleMesh

    def at(self, places: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
        low, high = torch.aminmax(self.mesh.vertices[:, 2])
        top = high + (high - low) + 1.0  # anywhere above
        origins = torch.cat((places, top.expand(len(places), 1)), dim=-1)
        down = places.new_tensor((0.0, 0.0, -1.0)).expand(len(places), 3)
        length = self.mesh.intersect(origins, down).length
        there = length.isfinite()
        return torch.where(there, top - length, 0.0), there
