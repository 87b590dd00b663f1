"""A digital surface model: the upper surface of a dense cloud on a grid of square cells, north up."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.dense.densify import DenseError
from torchrefrac.dense.upper_surface import fill_small_holes, upper_surface
from torchrefrac.scene import DenseCloud, Raster

MOST_CELLS = 50_000_000
SAMPLE, NEIGHBOURS, CELLS_A_SPACING = 20_000, 8, 1.5
TAIL, STRAY = 0.01, 2.0  # stray: beyond the range of the middle 98 %, by more than twice that range


def raster_of(cloud: DenseCloud, cell_size: float | None) -> Raster:
    """`rasterize`, for cells that an option chose. Raises DenseError where they are too small for the extent."""
    try:
        return rasterize(cloud, cell_size)
    except ValueError as error:
        raise DenseError(f"outputs.raster_cell: {error}") from None


def rasterize(cloud: DenseCloud, cell_size: float | None = None) -> Raster:
    """The upper surface of a dense cloud, one height a cell.

    A cell's height is the mean of the points of the highest surface in it that is well supported, weighted by
    1 / sigma^2. A surface is all that lies within 3 sigma, or the size of a cell where that is more, of its height;
    well supported is one with at least two points and a quarter of those of the best supported one of the cell (where
    no two points of a cell lie together, the points of the eight cells around it count too). The cell's sigma is the
    larger of what the sigmas and what the scatter of these points say. A hole with at least five of eight neighbours is
    the mean of opposite neighbours, exact where the surface is plane, and marked `filled`; its sigma counts half their
    difference. Edges of cells lie at multiples of cell_size. Left out are points and sigmas that are not finite, and
    points far outside of where nearly all lie: beyond the range of the middle 98 %, by more than twice that range.

    cell_size: side of a cell, in length_unit; where it is not given, about 1.5 times the spacing of the points
    (`point_spacing`), in two digits.

    Raises ValueError where cell_size is not above 0, or so small that the raster would have over 50 million cells.
    """
    if cell_size is not None and not 0.0 < cell_size < math.inf:
        raise ValueError(f"cell_size is {cell_size:g}, but must be a length above 0")
    cloud = cloud[_near(cloud.points) & cloud.sigma.isfinite()]
    points = cloud.points
    if cell_size is None:
        spacing = point_spacing(points)
        cell_size = float(f"{CELLS_A_SPACING * spacing:.2g}") if spacing > 0.0 else 1.0
    if not len(cloud):
        return _raster(cloud, points.new_zeros(0, dtype=torch.long), (0, 0), (0.0, 0.0), cell_size)
    low, high = points[:, :2].amin(dim=0).tolist(), points[:, :2].amax(dim=0).tolist()
    x_west, y_north = math.floor(low[0] / cell_size) * cell_size, math.ceil(high[1] / cell_size) * cell_size
    rows, columns = math.floor((y_north - low[1]) / cell_size) + 1, math.floor((high[0] - x_west) / cell_size) + 1
    if rows * columns > MOST_CELLS:
        raise ValueError(
            f"cell_size is {cell_size:g}, but makes {rows} x {columns} cells of a cloud {high[0] - low[0]:g} x "
            f"{high[1] - low[1]:g} {cloud.length_unit} wide; give a larger one, for at most {MOST_CELLS} cells"
        )
    row = ((y_north - points[:, 1]) / cell_size).floor().long().clamp(0, rows - 1)
    column = ((points[:, 0] - x_west) / cell_size).floor().long().clamp(0, columns - 1)
    framed = (row + 1) * (columns + 2) + column + 1
    return _raster(cloud, framed, (rows, columns), (x_west, y_north), cell_size)


def point_spacing(points: Float[Tensor, "n 3"]) -> float:
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


def _near(points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Which points are finite and not far outside of where nearly all lie."""
    near = points.isfinite().all(dim=-1)
    if not near.any():
        return near
    for values in (points[:, 0], points[:, 1]):
        inliers = values[near]
        tail = math.floor(TAIL * len(inliers))
        low, high = inliers.kthvalue(tail + 1).values, inliers.kthvalue(len(inliers) - tail).values
        margin = STRAY * (high - low)
        near = near & (values >= low - margin) & (values <= high + margin)
    return near


def _raster(
    cloud: DenseCloud, cell: Int[Tensor, " n"], shape: tuple[int, int], corner: tuple[float, float], cell_size: float
) -> Raster:
    """The raster of points that lie in these cells, counted in a grid with a frame of one empty cell around it."""
    framed = (shape[0] + 2, shape[1] + 2)
    size = framed[0] * framed[1]
    vectors, counts = cloud.points.new_zeros(5, size), cell.new_zeros(size)
    if len(cloud):
        occupied, values, members = upper_surface(cloud, cell, framed[1], cell_size)
        vectors[:, occupied] = values
        counts[occupied] = members
    filled = fill_small_holes(vectors, counts > 0, framed)

    def inner(grid: Shaped[Tensor, " size"]) -> Shaped[Tensor, "rows columns"]:
        return grid.unflatten(0, framed)[1:-1, 1:-1].contiguous()

    return Raster(
        height=inner(vectors[0]),
        sigma=inner(vectors[1]),
        count=inner(counts),
        colors=torch.stack([inner(plane.round().to(torch.uint8)) for plane in vectors[2:]], dim=-1),
        valid=inner((counts > 0) | filled),
        filled=inner(filled),
        x_west=corner[0],
        y_north=corner[1],
        cell_size=cell_size,
        length_unit=cloud.length_unit,
    )
