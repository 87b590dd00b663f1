"""Points that reproject best: triangulation in pixels, for any number of tracks of any length at once.

Linear triangulation minimises distances to rays, which weighs a far camera as much as a near one. The noise is in the
pixels, so the best point minimises the sum of squared reprojection errors through the water (the cost of Chang & Chen,
ICCV 2011, Eq. 20, in one point with its cameras fixed). Points know nothing of each other: each has a 3x3 system

    (H + m diag H) dx = -g,     H = sum w J^T J,     g = sum w J^T r

over its own observations, with the exact derivative J of the refractive projection, and its own damping m (see
`minimize_each`). Near the solution sigma^2 H^-1 is the covariance of the point.

It fails where rays are so nearly parallel that the cost falls all the way to infinity: the covariance then reaches
beyond the cameras. It finds the minimum next to its start. At the surface the projection has a kink, which a step
crosses only downhill.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.checks import at_least_single, require, require_floating
from torchrefrac.numerics import inverse_cholesky_3x3, segment_sum
from torchrefrac.optim import Quadratic, huber, minimize_each

MAX_DAMPING = 1e4
CONVERGED = 1e-10
SETTLED = 1e-2


@dataclass(frozen=True, eq=False)
class PointEstimate:
    """What is known of points, lengths in the unit of the cameras.

    points: where not valid the start; covariance: zero where not valid, a robust loss counts by its weights; rms:
    reprojection error in pixels; angle: largest between any two of its rays in the medium of the point, radians;
    in_front: every camera that observes the point can see it.

    valid: two views or more, in front, at most a tenth of the noise away from the minimum, and the standard
    deviation of the point less than its distance to the nearest camera.
    """

    points: Float[Tensor, "n 3"]
    covariance: Float[Tensor, "n 3 3"]
    rms: Float[Tensor, " n"]
    angle: Float[Tensor, " n"]
    in_front: Bool[Tensor, " n"]
    num_views: Int[Tensor, " n"]
    valid: Bool[Tensor, " n"]


@torch.no_grad()
def refine_points(
    cameras: RefractiveCamera,
    pixels: Float[Tensor, "observations 2"],
    point: Int[Tensor, " observations"],
    points: Float[Tensor, "n 3"],
    pixel_sigma: float = 1.0,
    loss_scale: float | None = None,
    max_iterations: int = 10,
    tolerance: float = CONVERGED,
) -> PointEstimate:
    """Minimise the reprojection error of each of `points` in its observations, from where it is.

    Points are in the unit of the cameras. Observation i is of point[i], in any order, at pixels[i] by cameras[i], a
    batch of as many. pixel_sigma:
    noise of a pixel coordinate, for the covariance; loss_scale: of a Huber loss, pixels; tolerance: a point stays where
    its cost would fall by no more than this part of it, by default far below the noise. Single precision is raised to
    double inside; nothing here is differentiable.
    """
    _check(cameras, pixels, point, points, pixel_sigma, loss_scale, max_iterations)
    require(tolerance, "tolerance", at_least=0.0)
    dtype = torch.promote_types(at_least_single(pixels).dtype, at_least_single(points).dtype)
    working = dtype if points.device.type == "mps" else torch.float64
    seen = _Observations(cameras.to(dtype=working), pixels.to(working), point, loss_scale)
    start, num_views = points.to(working), torch.bincount(point, minlength=len(points))
    rounding = (1e5 * torch.finfo(working).eps) ** 2  # of a hundred roundings in a pixel coordinate of a thousand
    found = minimize_each(
        seen.at((num_views >= 2)[point].nonzero()[:, 0]),
        start,
        max_iterations,
        tolerance,
        max_damping=MAX_DAMPING,
        rounding=rounding,
        undamped=True,
    )
    cost, gradient, information = found.quadratic
    factor = inverse_cholesky_3x3(information)
    covariance = pixel_sigma**2 * (factor.mT @ factor)
    spread = covariance.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    promised = 0.5 * (factor @ gradient[..., None]).square().sum(dim=(-2, -1))
    settled = found.stalled | (promised <= SETTLED * (cost + pixel_sigma**2))
    valid = (num_views >= 2) & cost.isfinite() & settled & (spread < _squared_distance(seen, found.states))
    best = torch.where(valid[:, None], found.states, start)
    square, in_front = seen.errors(best)
    return PointEstimate(
        points=best.to(dtype),
        covariance=torch.where(valid[:, None, None], covariance, 0.0).to(dtype),
        rms=(square / num_views.clamp(min=1)).sqrt().to(dtype),
        angle=_largest_angle(seen, best).to(dtype),
        in_front=in_front & (num_views > 0),
        num_views=num_views,
        valid=valid,
    )


class _Observations(NamedTuple):
    """Points as `SmallProblems`."""

    cameras: RefractiveCamera
    pixels: Float[Tensor, "observations 2"]
    point: Int[Tensor, " observations"]
    loss_scale: float | None

    def at(self, rows: Int[Tensor, " some"]) -> "_Observations":
        """Some of them."""
        return self._replace(cameras=self.cameras[rows], pixels=self.pixels[rows], point=self.point[rows])

    def subset(self, rows: Int[Tensor, " some"]) -> "_Observations":
        """Those of the points `rows`, which are numbered from zero."""
        place = torch.searchsorted(rows, self.point).clamp(max=len(rows) - 1)
        found = (rows[place] == self.point).nonzero()[:, 0]
        return self.at(found)._replace(point=place[found])

    def linearize(self, states: Float[Tensor, "n 3"]) -> Quadratic:
        """Half the sums of losses, infinite where one camera cannot see the point."""
        projected, jacobians, possible = self.cameras.project_with_jacobians(states[self.point])
        by_point, residual = jacobians.point, projected - self.pixels
        square = residual.square().sum(dim=-1)
        loss, weight = (square, torch.ones_like(square)) if self.loss_scale is None else huber(square, self.loss_scale)
        weighted = torch.where(possible, weight, 0.0)[:, None, None] * by_point
        columns = torch.cat((by_point, residual[..., None]), dim=-1)
        system = (weighted[..., :, None] * columns[..., None, :]).sum(dim=1).flatten(1)
        cost = torch.where(possible, 0.5 * loss, torch.inf)[:, None]
        total = segment_sum(torch.cat((system, cost), dim=-1), self.point, len(states))
        system = total[:, :12].unflatten(1, (3, 4))
        return Quadratic(total[:, 12], system[..., 3], system[..., :3])

    def errors(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
        """Sums of squared reprojection errors, and whether every camera can see the point."""
        projected, possible = self.cameras.project(points[self.point])
        rows = torch.stack(((projected - self.pixels).square().sum(dim=-1), (~possible).to(projected)), dim=-1)
        square, impossible = segment_sum(rows, self.point, len(points)).unbind(dim=-1)
        return square, impossible == 0.0


def _squared_distance(seen: _Observations, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """From each point to the nearest camera that observes it; infinite where there is none."""
    square = (points[seen.point] - seen.cameras.center_in_world).square().sum(dim=-1)
    nearest = square.new_full((len(points),), torch.inf)
    return nearest.scatter_reduce_(0, seen.point, square, "amin")


def _largest_angle(seen: _Observations, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Between any two rays of a point, radians.

    Sorted by point, all pairs of a track are met by shifting the list by 1, 2, ... up to the longest track. The chord
    tells small angles apart, which the cosine does not.
    """
    point, order = seen.point.sort(stable=True)
    directions = _directions(seen, points)[order]
    chord = directions.new_zeros(len(points))
    first, shift = torch.arange(len(point), device=point.device), 1
    while True:
        first = first[: torch.searchsorted(first, len(point) - shift)]
        first = first[point[first] == point[first + shift]]
        if not len(first):
            return 2.0 * (0.5 * chord).clamp(max=1.0).asin()
        between = (directions[first] - directions[first + shift]).norm(dim=-1)
        chord.scatter_reduce_(0, point[first], between, "amax")
        shift += 1


def _directions(seen: _Observations, points: Float[Tensor, "n 3"]) -> Float[Tensor, "observations 3"]:
    """Unit directions of the rays of the pixels: bent, but straight to a point on the camera's side."""
    _, directions, _ = seen.cameras.cast_rays(seen.pixels)
    dry = seen.cameras.plane_in_world().signed_distance(points[seen.point]) >= 0.0
    rows = dry.nonzero()[:, 0]
    return directions.index_copy(0, rows, seen.cameras[rows].view_directions(seen.pixels[rows]))


def _check(
    cameras: RefractiveCamera,
    pixels: Float[Tensor, "observations 2"],
    point: Int[Tensor, " observations"],
    points: Float[Tensor, "n 3"],
    pixel_sigma: float,
    loss_scale: float | None,
    max_iterations: int,
) -> None:
    for name, value, wanted, columns in (("pixels", pixels, "(N, 2)", 2), ("points", points, "(n, 3)", 3)):
        require_floating(value, name)
        if value.dim() != 2 or value.shape[1] != columns:
            raise ValueError(f"{name} has shape {tuple(value.shape)}, but must be {wanted}")
        require(value, name)
    if point.dtype != torch.long:
        raise ValueError(f"point has dtype {point.dtype}, but must hold row numbers of points, torch.long")
    batches = tuple(cameras.shape), (len(pixels),), tuple(point.shape)
    if len(set(batches)) > 1:
        raise ValueError(
            "cameras {}, pixels {} and point {} must be batches of one size, one entry for each observation".format(
                *batches
            )
        )
    low, high = (int(end) for end in point.aminmax()) if len(point) else (0, -1)
    if low < 0 or high >= len(points):
        raise ValueError(f"point holds ids from {low} to {high}, but must number the {len(points)} rows of points")
    require(pixel_sigma, "pixel_sigma", above=0.0)
    require(max_iterations, "max_iterations", at_least=0)
    if loss_scale is not None:
        require(loss_scale, "loss_scale", above=0.0)
