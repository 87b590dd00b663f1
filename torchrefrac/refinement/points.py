"""Points that reproject best: triangulation in pixels, for any number of tracks of any length at once.

Linear triangulation minimises distances to rays, which weighs a far camera as much as a near one. The noise is in the
pixels, so the best point minimises the sum of squared reprojection errors through the water (the cost of Chang & Chen,
ICCV 2011, Eq. 20, in one point with its cameras held). Points know nothing of each other: each has a 3x3 system

    (H + m diag H) dx = -g,     H = sum w J^T J,     g = sum w J^T r

over its own observations, with the exact derivative J of the refractive projection, and its own damping m
(Levenberg-Marquardt); observations of points that have converged are left out of the next pass. Near the solution
sigma^2 H^-1 is the covariance of the point.

It fails where rays are so nearly parallel that the cost falls all the way to infinity: the covariance then reaches
beyond the cameras. It finds the minimum next to its start. At the surface the projection has a kink, which a step
crosses only downhill.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.checks import at_least_single, require, require_floating
from torchrefrac.numerics import inverse_cholesky_3x3, segment_sum
from torchrefrac.optim import huber

INITIAL_DAMPING = 1e-4
MAX_DAMPING = 1e4
CONVERGED = 1e-10
SETTLED = 1e-2


@dataclass(frozen=True, eq=False)
class PointEstimate:
    """What is known of n points.

    points (n, 3), where not valid the start; covariance (n, 3, 3), zero where not valid, a robust loss counts by its
    weights; rms (n): reprojection error in pixels; angle (n): largest between any two of its rays in the medium of the
    point, radians; in_front (n): every camera that observes the point can see it; num_views (n).

    valid (n): two views or more, in front, at most a tenth of the noise away from the minimum, and the standard
    deviation of the point less than its distance to the nearest camera.
    """

    points: Tensor
    covariance: Tensor
    rms: Tensor
    angle: Tensor
    in_front: Tensor
    num_views: Tensor
    valid: Tensor


@torch.no_grad()
def refine_points(
    cameras: RefractiveCamera,
    pixels: Tensor,
    point: Tensor,
    points: Tensor,
    pixel_sigma: float = 1.0,
    loss_scale: float | None = None,
    max_iterations: int = 10,
) -> PointEstimate:
    """Minimise the reprojection error of each of `points` (n, 3) in its observations, from where it is.

    Observation i is of point[i] (N, long, in any order) at pixels[i] (N, 2) by cameras[i], a batch (N). pixel_sigma:
    noise of a pixel coordinate, for the covariance; loss_scale: of a Huber loss, pixels. Single precision is raised to
    double inside; nothing here is differentiable.
    """
    _check(cameras, pixels, point, points, pixel_sigma, loss_scale, max_iterations)
    dtype = torch.promote_types(at_least_single(pixels).dtype, at_least_single(points).dtype)
    working = dtype if points.device.type == "mps" else torch.float64
    seen = _Observations(cameras.to(dtype=working), pixels.to(working), point, loss_scale)
    num_views = torch.bincount(point, minlength=len(points))
    start = _fit(seen, points.to(working))
    found, stalled = _descend(seen, start, num_views >= 2, max_iterations)

    factor = inverse_cholesky_3x3(found.information)
    covariance = pixel_sigma**2 * (factor.mT @ factor)
    spread = covariance.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    settled = stalled | (_promise(found) <= SETTLED * (found.cost + pixel_sigma**2))
    valid = (num_views >= 2) & found.in_front & settled & (spread < _squared_distance(seen, found.points))
    best = _choose(valid, found, start)
    return PointEstimate(
        points=best.points.to(dtype),
        covariance=torch.where(valid[:, None, None], covariance, 0.0).to(dtype),
        rms=(best.square / num_views.clamp(min=1)).sqrt().to(dtype),
        angle=_largest_angle(seen, best.points).to(dtype),
        in_front=best.in_front & (num_views > 0),
        num_views=num_views,
        valid=valid,
    )


class _Observations(NamedTuple):
    cameras: RefractiveCamera
    pixels: Tensor
    point: Tensor
    loss_scale: float | None

    def of(self, wanted: Tensor) -> "_Observations":
        """Those of the points `wanted` (n)."""
        rows = wanted[self.point].nonzero()[:, 0]
        if len(rows) == len(self.point):
            return self
        return self._replace(cameras=self.cameras[rows], pixels=self.pixels[rows], point=self.point[rows])


class _Fit(NamedTuple):
    """Points (n, 3), half the sum of their losses (n), infinite where one camera cannot see the point, gradient (n, 3)
    and information H (n, 3, 3); square (n): the sum of squared errors without loss."""

    points: Tensor
    cost: Tensor
    gradient: Tensor
    information: Tensor
    square: Tensor
    in_front: Tensor


def _fit(seen: _Observations, points: Tensor) -> _Fit:
    projected, jacobians, possible = seen.cameras.project_with_jacobians(points[seen.point])
    by_point, residual = jacobians.point, projected - seen.pixels
    square = residual.square().sum(dim=-1)
    loss, weight = (square, torch.ones_like(square)) if seen.loss_scale is None else huber(square, seen.loss_scale)
    weighted = torch.where(possible, weight, 0.0)[:, None, None] * by_point
    columns = torch.cat((by_point, residual[..., None]), dim=-1)
    system = (weighted[..., :, None] * columns[..., None, :]).sum(dim=1)
    rows = torch.cat((system.flatten(1), torch.stack((0.5 * loss, square, (~possible).to(loss.dtype)), dim=-1)), dim=-1)
    total = segment_sum(rows, seen.point, len(points))
    system, (cost, square, impossible) = total[:, :12].unflatten(1, (3, 4)), total[:, 12:].unbind(dim=-1)
    in_front = impossible == 0.0
    return _Fit(points, torch.where(in_front, cost, torch.inf), system[..., 3], system[..., :3], square, in_front)


def _descend(seen: _Observations, fit: _Fit, pending: Tensor, max_iterations: int) -> tuple[_Fit, Tensor]:
    """The best fits of the points `pending` (n), and of which no step lowers the cost, however damped (n)."""
    damping = torch.full_like(fit.cost, INITIAL_DAMPING)
    pending = pending & ~_converged(fit)
    for _ in range(max_iterations):
        seen = seen.of(pending)
        if not len(seen.point):
            break
        tried = _fit(seen, torch.where(pending[:, None], fit.points + _step(fit, damping), fit.points))
        better = pending & (tried.cost < fit.cost)
        fit = _choose(better, tried, fit)
        damping = torch.where(better, 0.1 * damping, torch.where(pending, 10.0 * damping, damping))
        pending = pending & ~_converged(fit) & (damping <= MAX_DAMPING)
    return fit, damping > MAX_DAMPING


def _choose(first: Tensor, one: _Fit, other: _Fit) -> _Fit:
    chosen = (torch.where(first.view(-1, *(1,) * (a.dim() - 1)), a, b) for a, b in zip(one, other, strict=True))
    return _Fit(*chosen)


def _step(fit: _Fit, damping: Tensor) -> Tensor:
    diagonal = fit.information.diagonal(dim1=-2, dim2=-1)
    factor = inverse_cholesky_3x3(fit.information + torch.diag_embed(damping[:, None] * diagonal))
    return -(factor.mT @ (factor @ fit.gradient[..., None]))[..., 0]


def _promise(fit: _Fit) -> Tensor:
    """By how much an undamped step is expected to lower the cost (n)."""
    factor = inverse_cholesky_3x3(fit.information)
    return 0.5 * (factor @ fit.gradient[..., None]).square().sum(dim=(-2, -1))


def _converged(fit: _Fit) -> Tensor:
    return fit.in_front & (_promise(fit) <= CONVERGED * fit.cost + _rounding(fit.cost))


def _rounding(cost: Tensor) -> float:
    """The cost that rounding makes: of a hundred roundings in a pixel coordinate of a thousand."""
    return (1e5 * torch.finfo(cost.dtype).eps) ** 2


def _squared_distance(seen: _Observations, points: Tensor) -> Tensor:
    """From each point to the nearest camera that observes it (n); infinite where there is none."""
    square = (points[seen.point] - seen.cameras.center_in_world).square().sum(dim=-1)
    nearest = square.new_full((len(points),), torch.inf)
    return nearest.scatter_reduce_(0, seen.point, square, "amin")


def _largest_angle(seen: _Observations, points: Tensor) -> Tensor:
    """Between any two rays of a point, radians (n).

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


def _directions(seen: _Observations, points: Tensor) -> Tensor:
    """Unit directions (N, 3) of the rays of the pixels: bent, but straight to a point on the camera's side."""
    _, directions, _ = seen.cameras.cast_rays(seen.pixels)
    dry = seen.cameras.plane_in_world().signed_distance(points[seen.point]) >= 0.0
    rows = dry.nonzero()[:, 0]
    return directions.index_copy(0, rows, seen.cameras[rows].view_directions(seen.pixels[rows]))


def _check(
    cameras: RefractiveCamera,
    pixels: Tensor,
    point: Tensor,
    points: Tensor,
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
