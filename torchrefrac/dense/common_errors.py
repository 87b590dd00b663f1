"""What dense points have in common with the tie points about them: the errors of cameras and water."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from torchrefrac.scene import Scene, largest_deviation

NEIGHBOURS = 8
AT_ONCE = 1 << 16  # points whose neighbours are looked for


@dataclass(frozen=True)
class CommonDeviations:
    """Standard deviations of what errors of cameras and water do to n points: along the axis in which it is largest,
    and along x, y and z."""

    largest: Float[Tensor, " n"]
    along: Float[Tensor, "n 3"]


def common_deviations(points: Float[Tensor, "n 3"], scene: Scene) -> CommonDeviations:
    """What errors of cameras and water do to each point.

    Of a tie point it is what its covariance has beyond the one relative to the cameras; it changes slowly over a scene,
    and the mean of the nearest tie points holds for what lies between them. Zero where the scene does not know it.
    """
    known = scene.assessment
    zero = points.new_zeros(1)
    nothing = CommonDeviations(zero.expand(len(points)), zero.expand_as(points))
    if known.point_covariance is None or known.relative_covariance is None or not len(points):
        return nothing
    usable = scene.placed & known.point_covariance.isfinite().all(dim=(1, 2))
    common = (known.point_covariance - known.relative_covariance)[usable]
    if not len(common):
        return nothing
    tree = KDTree(scene.points[usable].cpu().numpy())
    count = min(NEIGHBOURS, len(common))
    values = torch.cat((largest_deviation(common).square()[:, None], common.diagonal(dim1=1, dim2=2).clamp(min=0.0)), 1)
    found = points.new_empty(len(points), 4)
    for rows in torch.arange(len(points)).split(AT_ONCE):
        _, nearest = tree.query(points[rows].cpu().numpy(), k=count)
        index = torch.from_numpy(nearest).reshape(len(rows), count).to(values.device)
        found[rows] = values[index].mean(dim=1).sqrt().to(points)
    return CommonDeviations(found[:, 0], found[:, 1:])
