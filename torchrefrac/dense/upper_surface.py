"""The upper surface among the points of each cell of a grid, and the small holes between such cells."""

import math

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.numerics import segment_sum
from torchrefrac.scene import DenseCloud

SIGMAS, PART, ROUNDS = 3.0, 4, 4  # a surface is this thick, has at least 1 / PART of the support of the best one
SHARPEST = 0.1  # no point counts as more exact than this part of the median sigma
HEIGHT_BITS = 34  # of a key, whose other bits are the cell
OPPOSITE = ((0, 1), (1, 0), (1, 1), (1, -1))  # row and column of one of each two opposite neighbours of a cell


def upper_surface(
    cloud: DenseCloud, cell: Int[Tensor, " n"], width: int, cell_size: float
) -> tuple[Int[Tensor, " m"], Float[Tensor, "5 m"], Int[Tensor, " m"]]:
    """Of the cells with points: their numbers; height, sigma and colour; how many points these are the mean of.

    cell: of each point, in a grid `width` cells wide; see `rasterize` for what the upper surface is.
    """
    keys, order = _keys(cell, cloud.points[:, 2], cloud.points[:, 2]).sort()
    z, sigma, colors, cell = cloud.points[order, 2], cloud.sigma[order], cloud.colors[order], cell[order]
    occupied, segment, members = cell.unique_consecutive(return_inverse=True, return_counts=True)
    thickness = (SIGMAS * sigma).clamp(min=cell_size)

    def support(rows: Int[Tensor, " r"], offset: int, reach: Float[Tensor, " r"]) -> Int[Tensor, " r"]:
        """How many points of the cell at this offset lie within reach of the height of each of these points."""
        low, high = (_keys(cell[rows] + offset, z[rows] + side * reach, z) for side in (-1, 1))
        return torch.searchsorted(keys, high, right=True) - torch.searchsorted(keys, low)

    every = torch.arange(len(z), device=z.device)
    supported = support(every, 0, thickness)
    lone = every[(_largest(supported, segment, len(occupied))[segment] == 1) & (members[segment] > 1)]
    around = [side * (row * width + column) for row, column in OPPOSITE for side in (-1, 1)]
    for offset in around:
        supported[lone] += support(lone, offset, 2.0 * thickness[lone])
    best = _largest(supported, segment, len(occupied))[segment]
    well_supported = (supported >= best.clamp(max=2)) & (PART * supported >= best)
    level = _largest(z.where(well_supported, -math.inf), segment, len(occupied))

    positive = sigma[sigma > 0.0]
    floor = SHARPEST * float(positive.median()) if len(positive) else 1.0
    weight = sigma.clamp(min=floor) ** -2
    chosen, total = torch.zeros_like(weight, dtype=torch.bool), torch.zeros_like(level)
    for _ in range(ROUNDS):  # from the top of the surface to its middle
        near = (z - level[segment]).abs() <= thickness
        is_empty = segment_sum(near.long(), segment, len(occupied)) == 0
        chosen = torch.where(is_empty[segment], chosen, near)
        total = segment_sum(weight * chosen, segment, len(occupied))
        level = segment_sum(weight * chosen * z, segment, len(occupied)) / total
    share = weight * chosen / total[segment]
    count = segment_sum(chosen.long(), segment, len(occupied))
    formal = segment_sum((share * sigma) ** 2, segment, len(occupied))
    scatter = segment_sum(share * (z - level[segment]) ** 2, segment, len(occupied)) / (count - 1).clamp(min=1)
    color = segment_sum(share[:, None] * colors, segment, len(occupied))
    return occupied, torch.stack((level, torch.maximum(formal, scatter).sqrt(), *color.T)), count


def _keys(cell: Int[Tensor, " n"], z: Float[Tensor, " n"], every_z: Float[Tensor, " all"]) -> Int[Tensor, " n"]:
    """Whole numbers that ascend with the cell, and within a cell with the height."""
    low, high = every_z.min(), every_z.max()
    steps = torch.where(high > low, (2**HEIGHT_BITS - 1) / (high - low), 0.0)
    return (cell << HEIGHT_BITS) + ((z.clamp(low, high) - low) * steps).long()


def _largest(
    values: Shaped[Tensor, " n"], segment: Int[Tensor, " n"], num_segments: int
) -> Shaped[Tensor, "{num_segments}"]:
    """The largest of the values of each segment, none of which is empty."""
    return values.new_zeros(num_segments).scatter_reduce_(0, segment, values, "amax", include_self=False)


def fill_small_holes(
    vectors: Float[Tensor, "5 size"], valid: Bool[Tensor, " size"], framed: tuple[int, int]
) -> Bool[Tensor, " size"]:
    """Interpolate small holes of height, sigma and colour where they lie; which cells those are."""
    grid = valid.unflatten(0, framed)
    neighbours = torch.zeros_like(grid, dtype=torch.uint8)
    for row, column in OPPOSITE:
        for side in (-1, 1):
            neighbours += torch.roll(grid, (side * row, side * column), (0, 1))
    small = ~grid & (neighbours >= 5)
    small[0], small[-1], small[:, 0], small[:, -1] = False, False, False, False
    hole = small.flatten().nonzero()[:, 0]
    total, pairs = vectors.new_zeros(5, len(hole)), vectors.new_zeros(len(hole))
    for row, column in OPPOSITE:  # five of eight neighbours have one opposite pair at least
        one, other = hole + row * framed[1] + column, hole - row * framed[1] - column
        a, b = vectors[:, one], vectors[:, other]
        both = (a + b) / 2.0
        both[1] = (a[1] ** 2 + b[1] ** 2) / 2.0 + ((a[0] - b[0]) / 2.0) ** 2
        is_pair = (valid[one] & valid[other]).to(vectors.dtype)
        total += both * is_pair
        pairs += is_pair
    mean = total / pairs
    mean[1] = mean[1].sqrt()
    vectors[:, hole] = mean
    return small.flatten()
