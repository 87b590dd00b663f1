"""A digital surface model: the upper surface of a dense cloud on a grid of square cells, north up."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.dense.densify import DenseError
from torchrefrac.numerics import segment_sum
from torchrefrac.scene import DenseCloud, Raster, RasterGrid

MOST_CELLS = 50_000_000
SAMPLE, NEIGHBOURS, CELLS_A_SPACING = 20_000, 8, 1.5
SIGMAS, PART, ROUNDS = 3.0, 4, 4  # a surface is this thick, has at least 1 / PART of the support of the best one
SHARPEST = 0.1  # no point counts as more exact than this part of the median sigma
HEIGHT_BITS = 34  # of a key, whose other bits are the cell
OPPOSITE = ((0, 1), (1, 0), (1, 1), (1, -1))  # row and column of one of each two opposite neighbours of a cell
TAIL, STRAY = 0.01, 2.0  # stray: beyond the range of the middle 98 %, by more than twice that range

CHUNK = 1_000_000  # points that are looked at together


class Points(Protocol):
    """A dense cloud, or a file of one: so many points, those of some rows, and the unit of their coordinates."""

    @property
    def length_unit(self) -> str: ...

    def __len__(self) -> int: ...

    def __getitem__(self, rows: Int[Tensor, " k"]) -> DenseCloud: ...


def in_chunks(points: Points) -> Iterator[tuple[Int[Tensor, " k"], DenseCloud]]:
    """All of them, a million at a time, and which these are."""
    for start in range(0, len(points), CHUNK):
        rows = torch.arange(start, min(start + CHUNK, len(points)))
        yield rows, points[rows]


def raster_of(cloud: DenseCloud, cell_size: float | None) -> Raster:
    """`rasterize`, for cells that an option chose. Raises DenseError where they are too small for the extent."""
    with _of_an_option():
        return rasterize(cloud, cell_size)


def raster_in_grid(points: Points, grid: RasterGrid, near: Bool[Tensor, " n"]) -> Raster:
    """`rasterize_in`, likewise."""
    with _of_an_option():
        return rasterize_in(points, grid, near)


@contextmanager
def _of_an_option() -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise DenseError(f"outputs.raster_cell: {error}") from None


def rasterize(cloud: DenseCloud, cell_size: float | None = None) -> Raster:
    """The upper surface of a dense cloud, one height a cell.

    A cell's height is the mean of the points of the highest surface in it that is well supported, weighted by 1 /
    sigma^2. A surface is all that lies within 3 sigma, or the size of a cell where that is more, of its height; well
    supported is one with at least two points and a quarter of those of the best supported one of the cell (where no two
    points of a cell lie together, the points of the eight cells around it count too). The cell's sigma, of its height,
    has two parts: the larger of what the sigmas and what the scatter of these points say, which falls with their
    number, and what they have in common (`common_sigma`), which does not. A hole with at least five of eight neighbours
    is the mean of opposite neighbours, exact where the surface is plane, and marked `filled`; its sigma counts half
    their difference. Edges of cells lie at multiples of cell_size. Left out are points and sigmas that are not finite,
    and points far outside of where nearly all lie: beyond the range of the middle 98 %, by more than twice that range.

    cell_size: side of a cell, in length_unit; where it is not given, about 1.5 times the spacing of the points
    (`point_spacing`), in two digits.

    Raises ValueError where cell_size is not above 0, or so small that the raster would have over 50 million cells.
    """
    return rasterize_in(cloud, *grid_of(cloud, cell_size))


def rasterize_in(points: Points, grid: RasterGrid, near: Bool[Tensor, " n"]) -> Raster:
    """The same in a grid and of the points that `grid_of` has found."""
    if grid.rows * grid.columns > MOST_CELLS:
        raise ValueError(
            f"cell_size is {grid.cell_size:g}, but makes {grid.rows} x {grid.columns} cells of a cloud "
            f"{grid.columns * grid.cell_size:g} x {grid.rows * grid.cell_size:g} {points.length_unit} wide; give a "
            f"larger one, for at most {MOST_CELLS} cells"
        )
    return raster_in(points[near.nonzero()[:, 0]], grid)


def grid_of(points: Points, cell_size: float | None = None) -> tuple[RasterGrid, Bool[Tensor, " n"]]:
    """The cells that points lie in, see `rasterize`, and which of the points count.

    Raises ValueError where cell_size is not above 0.
    """
    if cell_size is not None and not 0.0 < cell_size < math.inf:
        raise ValueError(f"cell_size is {cell_size:g}, but must be a length above 0")
    xy, known = torch.empty(len(points), 2, dtype=torch.float64), torch.empty(len(points), dtype=torch.bool)
    for rows, some in in_chunks(points):
        xy[rows] = some.points[:, :2]
        known[rows] = some.points.isfinite().all(dim=-1) & some.sigma.isfinite()
    known = _near(xy, known)
    if cell_size is None:
        spacing = point_spacing(xy[known])
        cell_size = float(f"{CELLS_A_SPACING * spacing:.2g}") if spacing > 0.0 else 1.0
    if not bool(known.any()):
        return RasterGrid(0, 0, 0.0, 0.0, cell_size), known
    (west, east), (south, north) = (_extent(xy[:, axis], known) for axis in (0, 1))
    x_west, y_north = math.floor(west / cell_size) * cell_size, math.ceil(north / cell_size) * cell_size
    rows, columns = math.floor((y_north - south) / cell_size) + 1, math.floor((east - x_west) / cell_size) + 1
    return RasterGrid(rows, columns, x_west, y_north, cell_size), known


def _extent(values: Float[Tensor, " n"], known: Bool[Tensor, " n"]) -> tuple[float, float]:
    return float(values.where(known, torch.inf).min()), float(values.where(known, -torch.inf).max())


def raster_in(cloud: DenseCloud, grid: RasterGrid, sharpest: float | None = None) -> Raster:
    """The upper surface of a cloud, see `rasterize`, in the cells of a grid; points beyond it count as in its outermost
    cells. sharpest: the sigma below which none counts as more exact; None: by the cloud itself."""
    if not grid.rows * grid.columns:
        nothing = torch.zeros(0, dtype=torch.long)
        return _raster(cloud[nothing], nothing, grid, sharpest)
    row, column = grid.cells_of(cloud.points)
    return _raster(cloud, (row + 1) * (grid.columns + 2) + column + 1, grid, sharpest)


def point_spacing(points: Float[Tensor, "n d"]) -> float:
    """The typical horizontal spacing of points: the side of the square that each has to itself.

    From the median distance d to the eighth nearest neighbour, of at most 20,000 of the points: the circle of radius d
    has eight in it, whether they lie on a grid or by chance. Zero where there are no two points apart.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    neighbours = min(NEIGHBOURS, len(points) - 1)
    if neighbours < 1:
        return 0.0
    plane = points[:, :2].detach().cpu().numpy()
    tree = KDTree(plane, compact_nodes=False, balanced_tree=False)
    distance, _ = tree.query(plane[:: math.ceil(len(plane) / SAMPLE)], k=neighbours + 1)
    return float(np.median(distance[:, -1])) * math.sqrt(math.pi / neighbours)


def _near(plane: Float[Tensor, "n 2"], known: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Which of the known points are not far outside of where nearly all lie."""
    near = known.clone()
    if not near.any():
        return near
    for values in plane.T:
        inliers = values[near]
        tail = math.floor(TAIL * len(inliers))
        low, high = inliers.kthvalue(tail + 1).values, inliers.kthvalue(len(inliers) - tail).values
        margin = STRAY * (high - low)
        near &= (values >= low - margin) & (values <= high + margin)
    return near


def sharpest_of(sigma: Float[Tensor, " n"]) -> float:
    """The sigma below which no point of a cloud counts as more exact."""
    positive = sigma[sigma > 0.0]
    return SHARPEST * float(positive.median()) if len(positive) else 1.0


def _raster(cloud: DenseCloud, cell: Int[Tensor, " n"], grid: RasterGrid, sharpest: float | None) -> Raster:
    """The raster of points that lie in these cells, counted in a grid with a frame of one empty cell around it."""
    framed = (grid.rows + 2, grid.columns + 2)
    size = framed[0] * framed[1]
    vectors, counts = cloud.points.new_zeros(6, size), cell.new_zeros(size)
    if len(cloud):
        occupied, values, members = _upper_surface(cloud, cell, framed[1], grid.cell_size, sharpest)
        vectors[:, occupied] = values
        counts[occupied] = members
    filled = _fill_small_holes(vectors, counts > 0, framed)

    def inner(values: Shaped[Tensor, " size"]) -> Shaped[Tensor, "rows columns"]:
        return values.unflatten(0, framed)[1:-1, 1:-1].contiguous()

    return Raster(
        height=inner(vectors[0]),
        sigma=inner(vectors[1]),
        count=inner(counts),
        colors=torch.stack([inner(plane.round().to(torch.uint8)) for plane in vectors[2:5]], dim=-1),
        valid=inner((counts > 0) | filled),
        filled=inner(filled),
        x_west=grid.x_west,
        y_north=grid.y_north,
        cell_size=grid.cell_size,
        length_unit=cloud.length_unit,
        views=inner(vectors[5]),
    )


def _upper_surface(
    cloud: DenseCloud, cell: Int[Tensor, " n"], width: int, cell_size: float, sharpest: float | None
) -> tuple[Int[Tensor, " m"], Float[Tensor, "6 m"], Int[Tensor, " m"]]:
    """Of the cells with points: their numbers; height, sigma, colour and views; how many points these are the mean of.

    cell: of each point, in a grid `width` cells wide; see `rasterize` for what the upper surface is.
    """
    keys, order = _keys(cell, cloud.points[:, 2], cloud.points[:, 2]).sort()
    z, sigma, colors, cell = cloud.points[order, 2], cloud.sigma[order], cloud.colors[order], cell[order]
    common = cloud.common_sigma[order].square()
    own = (cloud.axis_sigma[order, 2].square() - common).clamp(min=0.0)
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

    weight = sigma.clamp(min=sharpest_of(sigma) if sharpest is None else sharpest) ** -2
    chosen, total = torch.zeros_like(weight, dtype=torch.bool), torch.zeros_like(level)
    for _ in range(ROUNDS):  # from the top of the surface to its middle
        near = (z - level[segment]).abs() <= thickness
        is_empty = segment_sum(near.long(), segment, len(occupied)) == 0
        chosen = torch.where(is_empty[segment], chosen, near)
        total = segment_sum(weight * chosen, segment, len(occupied))
        level = segment_sum(weight * chosen * z, segment, len(occupied)) / total
    share = weight * chosen / total[segment]
    count = segment_sum(chosen.long(), segment, len(occupied))
    formal = segment_sum(share.square() * own, segment, len(occupied))
    together = segment_sum(share * common, segment, len(occupied))
    scatter = segment_sum(share * (z - level[segment]) ** 2, segment, len(occupied)) / (count - 1).clamp(min=1)
    color = segment_sum(share[:, None] * colors, segment, len(occupied))
    views = segment_sum(share * cloud.views[order], segment, len(occupied))
    return occupied, torch.stack((level, (torch.maximum(formal, scatter) + together).sqrt(), *color.T, views)), count


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


def _fill_small_holes(
    vectors: Float[Tensor, "6 size"], valid: Bool[Tensor, " size"], framed: tuple[int, int]
) -> Bool[Tensor, " size"]:
    """Interpolate small holes of height, sigma, colour and views where they lie; which cells those are."""
    grid = valid.unflatten(0, framed)
    neighbours = torch.zeros_like(grid, dtype=torch.uint8)
    for row, column in OPPOSITE:
        for side in (-1, 1):
            neighbours += torch.roll(grid, (side * row, side * column), (0, 1))
    small = ~grid & (neighbours >= 5)
    small[0], small[-1], small[:, 0], small[:, -1] = False, False, False, False
    hole = small.flatten().nonzero()[:, 0]
    total, pairs = vectors.new_zeros(6, len(hole)), vectors.new_zeros(len(hole))
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
