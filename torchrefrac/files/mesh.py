"""The surface of a raster as triangles."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchrefrac.files.ply import kind_of_coordinates, write_vertices
from torchrefrac.scene.raster import Raster

if TYPE_CHECKING:
    import trimesh

MAX_SLOPE_DEG = 80.0
CHANNELS = ("red", "green", "blue", "alpha")
WITHOUT = ((0, (2, 3, 1), 3), (1, (0, 2, 3), 2), (2, (0, 3, 1), 1), (3, (0, 2, 1), 0))
"""The four triangles of a quad of corners north-west, north-east, south-west, south-east: the corner that a triangle
lacks, its own, counter-clockwise seen from above, and the one with its right angle."""


def height_field_mesh(raster: Raster, max_slope_deg: float = MAX_SLOPE_DEG) -> "trimesh.Trimesh":
    """Triangulate the valid cells of a raster: vertices at their centres, coloured, normals up.

    Between four neighbouring cells there are two triangles, parted along the diagonal with the smaller difference in
    height, where all are valid, and one where three are. A triangle that is steeper than max_slope_deg spans an edge
    of a surface and what lies behind it, and is left out, as are cells that are in no triangle. Coordinates are those
    of the world frame, in length_unit.

    Raises ValueError where max_slope_deg does not lie above 0 and at most at 90.
    """
    import trimesh  # noqa: PLC0415 - slow to import, needed only here

    if not 0.0 < max_slope_deg <= 90.0:
        raise ValueError(f"max_slope_deg is {max_slope_deg:g}, but must lie above 0 and be at most 90")
    vertices, colors, faces = _triangulate(raster, max_slope_deg)
    return trimesh.Trimesh(vertices.numpy(), faces.numpy(), vertex_colors=colors.numpy(), process=False)


def write_mesh(mesh: "trimesh.Trimesh", path: str | Path, sigma: Float[Tensor, " n"] | None = None) -> None:
    """Write a mesh as binary PLY, whole or not at all: x y z, and the colours of the vertices where it has them.

    Coordinates are float32, or float64 where that would round away what is known of them, as far from the origin of a
    map. sigma: standard deviations of its surface, where they are known.
    """
    from trimesh.visual import ColorVisuals  # noqa: PLC0415 - slow to import, needed only here

    vertices, faces = torch.tensor(mesh.vertices), torch.tensor(mesh.faces)
    kind = kind_of_coordinates(vertices, sigma)
    columns = [(name, kind, column) for name, column in zip("xyz", vertices.T, strict=True)]
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
        colors = torch.tensor(mesh.visual.vertex_colors)
        columns += [(name, "u1", column) for name, column in zip(CHANNELS, colors.T, strict=True)]
    write_vertices(columns, Path(path), faces=faces)


def _triangulate(
    raster: Raster, max_slope_deg: float
) -> tuple[Float[Tensor, "n 3"], UInt8[Tensor, "n 3"], Int[Tensor, "m 3"]]:
    """Vertices, colours and faces on the CPU."""
    height, valid = raster.height.cpu(), raster.valid.cpu()
    if min(height.shape) < 2:
        return height.new_zeros(0, 3), raster.colors.cpu().new_zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)
    number = torch.arange(height.numel()).view(height.shape)
    corner, z, is_valid = (
        torch.stack((grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]), dim=-1).flatten(0, 1)
        for grid in (number, height, valid)
    )
    along = (z[:, 0] - z[:, 3]).abs() <= (z[:, 1] - z[:, 2]).abs()
    steepest = math.tan(math.radians(max_slope_deg)) * raster.cell_size if max_slope_deg < 90.0 else math.inf
    faces = []
    for lacking, (a, b, c), right in WITHOUT:
        # Without the north-east or the south-west corner the long side is the diagonal from north-west to south-east.
        fits = along if lacking in (1, 2) else ~along
        legs = [z[:, k] - z[:, right] for k in (a, b, c) if k != right]
        chosen = is_valid[:, [a, b, c]].all(dim=-1) & (fits | ~is_valid[:, lacking])
        chosen &= legs[0] ** 2 + legs[1] ** 2 <= steepest**2
        faces.append(corner[chosen][:, [a, b, c]])
    triangles = torch.cat(faces)
    used = torch.zeros(height.numel(), dtype=torch.bool)
    used[triangles.flatten()] = True
    x, y = raster.x.cpu().expand(height.shape), raster.y.cpu()[:, None].expand(height.shape)
    vertices = torch.stack((x, y, height), dim=-1).flatten(0, 1)[used]
    return vertices, raster.colors.cpu().flatten(0, 1)[used], (used.cumsum(0) - 1)[triangles]
