"""Points that were placed as if there were no water, put where refraction says that they are.

A camera at c saw the apparent point a in the straight direction a - c. Its light came through the surface where this
line crosses it, and from there it goes on as Snell's law says. The bent rays of all cameras that see the point are met
in the point with the least sum of squared distances, each over the square of the way from camera to apparent point.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.correction.rules import CorrectionRules
from torchrefrac.geometry import Plane, triples
from torchrefrac.minimal import triangulate
from torchrefrac.minimal.rays import slopes
from torchrefrac.numerics import inverse_cholesky_3x3, like, morton_code
from torchrefrac.refraction import FlatInterface, refract_rays
from torchrefrac.scene import Viewpoints, largest_deviation

PAIRS = 1 << 17  # of points and cameras that are looked at together


@dataclass(frozen=True, eq=False)
class Correction:
    """Points after their correction, and what is known of each.

    below: which of the points given lie below the water's surface. views: by how many cameras a point was corrected, 0
    where it was not and stands as it was given. level: height of the water above it. incidence: mean angle of the rays
    in air to the vertical, radians. sigma: standard deviation along the axis in which a point is known worst, from the
    angles and from how far the rays pass by; infinite where it was not corrected or nothing fixes it. misfit: root mean
    square distance of its rays. What is of corrected points alone is zero for others.
    """

    points: Float[Tensor, "n 3"]
    level: Float[Tensor, " n"]
    below: Bool[Tensor, " n"]
    apparent_depth: Float[Tensor, " n"]
    views: Int[Tensor, " n"]
    incidence: Float[Tensor, " n"]
    sigma: Float[Tensor, " n"]
    misfit: Float[Tensor, " n"]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def corrected(self) -> Bool[Tensor, " n"]:
        """Which points were corrected."""
        return self.views > 0

    @property
    def depth(self) -> Float[Tensor, " n"]:
        """Of points below the water's surface, 0 of others."""
        return torch.where(self.below, self.level - self.points[:, 2], 0.0)


class _Rays(NamedTuple):
    """The straight ways from cameras to a block of apparent points, and which of them exist."""

    center: Float[Tensor, "b k 3"]
    offset: Float[Tensor, "b k 3"]
    present: Bool[Tensor, "b k"]


class _Block(NamedTuple):
    """What `Correction` says of points below the surface."""

    points: Float[Tensor, "b 3"]
    views: Int[Tensor, " b"]
    incidence: Float[Tensor, " b"]
    sigma: Float[Tensor, " b"]
    misfit: Float[Tensor, " b"]


def correct_points(
    points: Float[Tensor, "n 3"],
    level: Float[Tensor, " n"],
    wet: Bool[Tensor, " n"],
    viewpoints: Viewpoints,
    rules: CorrectionRules,
) -> Correction:
    """Correct the apparent points that lie below the water, in blocks of bounded memory; all others stay as they are,
    to the last bit.

    level: height of the surface, taken as horizontal, above or below each point; wet: where there is water. float64.
    A point that fewer cameras see than the rules want, or whose rays do not meet below the surface, is not corrected.
    """
    below = wet & (points[:, 2] < level) & points.isfinite().all(dim=-1)
    rows = below.nonzero()[:, 0]
    rows = rows[morton_code(points[rows]).argsort()]
    n = len(points)
    found = Correction(
        points=points.clone(),
        level=level,
        below=below,
        apparent_depth=torch.where(below, level - points[:, 2], 0.0),
        views=torch.zeros(n, dtype=torch.long),
        incidence=torch.zeros_like(level),
        sigma=torch.full_like(level, torch.inf),
        misfit=torch.zeros_like(level),
    )
    for block in _blocks(rows, len(viewpoints)):
        part = _correct_block(points[block], level[block], viewpoints, rules)
        done = part.views > 0
        for name, values in part._asdict().items():
            getattr(found, name)[block[done]] = values[done]
    return found


def _blocks(rows: Int[Tensor, " k"], cameras: int) -> Iterator[Int[Tensor, " b"]]:
    if len(rows):
        yield from rows.split(max(PAIRS // max(cameras, 1), 1))


def _correct_block(
    points: Float[Tensor, "b 3"], level: Float[Tensor, " b"], viewpoints: Viewpoints, rules: CorrectionRules
) -> _Block:
    """views is 0 where the points are not corrected; everything else is then of no meaning."""
    rays = _rays(points, level, viewpoints, rules)
    surface = FlatInterface(rules.index_ratio, plane=Plane((0.0, 0.0, 1.0), level[:, None]))
    origin, direction, valid = refract_rays(rays.center, rays.offset, surface)
    present = rays.present & valid
    distance_sq = triples.dot(triples.split(rays.offset), triples.split(rays.offset))
    weight = torch.where(present, 1.0 / distance_sq, 0.0)
    if rules.method == "rays":
        true, met = triangulate(origin, direction, weight)
    else:
        true, met = _mean(points, level, rays.offset, present, rules.index_ratio)
    views = present.sum(dim=-1)
    good = met & (views >= rules.min_views) & (true[:, 2] < level)
    miss_sq = _miss_sq(true, origin, direction)
    count = views.clamp(min=1)
    cosine = -rays.offset[..., 2] / distance_sq.sqrt()
    angle = torch.where(present, cosine.clamp(-1.0, 1.0).acos(), 0.0)
    return _Block(
        true,
        torch.where(good, views, 0),
        angle.sum(dim=-1) / count,
        _sigma(direction, weight, miss_sq, views, rules),
        (torch.where(present, miss_sq, 0.0).sum(dim=-1) / count).sqrt(),
    )


def _rays(
    points: Float[Tensor, "b 3"], level: Float[Tensor, " b"], viewpoints: Viewpoints, rules: CorrectionRules
) -> _Rays:
    """Of the cameras that see points of the block, side by side: as many columns as the point with most of them has."""
    steepest = like(rules.max_angle_deg, points).deg2rad().tan()
    farthest = math.inf if rules.max_distance is None else rules.max_distance
    low, high = torch.aminmax(points, dim=0)
    away = torch.maximum(low - viewpoints.center, viewpoints.center - high)[:, :2].clamp(min=0.0).norm(dim=-1)
    near = viewpoints[away <= (steepest * (viewpoints.center[:, 2] - low[2])).clamp(max=farthest)]
    center = near.center.T.contiguous()
    offset = points.T[:, :, None] - center[:, None]  # components first, so that each runs through contiguous memory
    distance_sq = offset[0].square() + offset[1].square()
    seen = near.see(offset.movedim(0, -1)) & (center[2] > level[:, None]) & (offset[2] < 0.0)
    seen = seen & (distance_sq <= (steepest * offset[2]).square())
    if rules.max_distance is not None:
        seen = seen & (distance_sq <= farthest**2)
    most = int(seen.sum(dim=-1).max())
    chosen = seen.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[:, :most]
    picked = offset.gather(2, chosen.expand(3, -1, -1)).movedim(0, -1)
    return _Rays(center[:, chosen].movedim(0, -1), picked, seen.gather(1, chosen))


def _mean(
    points: Float[Tensor, "b 3"],
    level: Float[Tensor, " b"],
    offset: Float[Tensor, "b k 3"],
    present: Bool[Tensor, "b k"],
    index_ratio: float,
) -> tuple[Float[Tensor, "b 3"], Bool[Tensor, " b"]]:
    """At the same x and y, the mean of the depths h = h_a tan(r) / tan(i) that single cameras give, r being the angle
    in air and i that in the water, sin(r) = n sin(i)."""
    down = torch.where(present[..., None], offset, offset.new_tensor((0.0, 0.0, -1.0)))
    _, factor = slopes(down, like(index_ratio, points))
    count = present.sum(dim=-1)
    mean = torch.where(present, factor, 0.0).sum(dim=-1) / count.clamp(min=1)
    depth = (level - points[:, 2]) * mean
    return torch.cat((points[:, :2], (level - depth)[:, None]), dim=-1), count > 0


def _miss_sq(
    points: Float[Tensor, "b 3"], origin: Float[Tensor, "b k 3"], direction: Float[Tensor, "b k 3"]
) -> Float[Tensor, "b k"]:
    """Squared distances of points from their rays."""
    across = triples.cross(triples.split(points[:, None] - origin), triples.split(direction))
    return triples.dot(across, across)


def _sigma(
    direction: Float[Tensor, "b k 3"],
    weight: Float[Tensor, "b k"],
    miss_sq: Float[Tensor, "b k"],
    views: Int[Tensor, " b"],
    rules: CorrectionRules,
) -> Float[Tensor, " b"]:
    """Standard deviation along the worst axis: by the angle's, or by the angle by which the rays pass by where that is
    larger."""
    identity = torch.eye(3, dtype=direction.dtype)
    weighted = weight[..., None] * direction
    normal = identity * weight.sum(dim=-1)[:, None, None] - weighted.mT @ direction
    freedom = (2 * views - 3).clamp(min=1)
    by_rays = (weight * miss_sq).sum(dim=-1) / freedom
    variance = by_rays.clamp(min=like(rules.angle_sigma_deg, by_rays).deg2rad().square())
    factor = inverse_cholesky_3x3(normal)
    sigma = largest_deviation(variance[:, None, None] * (factor.mT @ factor))
    return torch.where(views > 1, sigma, torch.inf)
