"""What each view sees of the finished surface."""

import torch
from jaxtyping import Shaped
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import PixelRays, depth_in
from torchrefrac.scene import DepthMap

THICKNESS = 4.0  # footprints: what lies farther behind its surroundings is hidden by them


def depth_map(patches: Patches, camera: RefractiveCamera, name: str, cell: int, length_unit: str) -> DepthMap:
    """The nearest patch in each cell, met by the ray of the cell's centre."""
    intrinsics = camera.intrinsics
    rows, columns = intrinsics.height // cell, intrinsics.width // cell
    pixels, valid = camera.project(patches.points, inside_image=True)
    column, row = (pixels / cell).long().unbind(dim=-1)
    use = (valid & patches.facing(camera) & (column < columns) & (row < rows)).nonzero()[:, 0]
    at, depth = (row * columns + column)[use], depth_in(camera, patches.points[use])
    nearest = torch.full((rows * columns,), torch.inf, dtype=depth.dtype).scatter_reduce(0, at, depth, "amin")
    around = -torch.nn.functional.max_pool2d(-nearest.view(1, 1, rows, columns), 3, stride=1, padding=1).flatten()
    front = (depth == nearest[at]) & (depth <= around[at] + THICKNESS * cell * patches.footprint[use])
    at, use = at[front], use[front]
    centers = torch.stack((at % columns + 0.5, at // columns + 0.5), dim=-1) * cell
    rays = PixelRays.cast(camera, centers)
    points = rays.at(rays.meet(patches.points[use], patches.normals[use]))
    close = (points - patches.points[use]).norm(dim=-1) < 2.0 * cell * patches.footprint[use]
    points = torch.where(close[:, None], points, patches.points[use])

    def spread(values: Shaped[Tensor, "k *rest"]) -> Shaped[Tensor, "rows columns *rest"]:
        table = values.new_zeros(rows * columns, *values.shape[1:])
        table[at] = values
        return table.view(rows, columns, *values.shape[1:])

    return DepthMap(
        name=name,
        step=cell,
        points=spread(points),
        depth=spread(depth_in(camera, points)),
        sigma=spread(patches.sigma[use]),
        valid=spread(torch.ones_like(at, dtype=torch.bool)),
        length_unit=length_unit,
    )
