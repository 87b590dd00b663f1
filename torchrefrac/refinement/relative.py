"""Refinement of the relative pose of two cameras above water: both tilts, heading and centre, all points eliminated.

A model is a row of eight numbers: the tilt of the first camera (2) and of the second (2) against the measured verticals
(see `tilt`), the heading of the second camera, and its centre (3), where the first camera stands at (0, 0, height) with
heading 0. The cost is half the sum of squared epipolar errors in pixels (see `epipolar`), truncated, plus gravity as a
prior on the tilts. To first order in the noise it is the bundle adjustment of both cameras and all points.

A wrong match that happens to lie near its epipolar curve implies a depth anywhere along it. Near nadir the pose has
weak directions in which a few of these can pull it away by many standard deviations, so that the fit is left to matches
whose depth is not far from that of the bulk.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchrefrac.checks import is_wrapped
from torchrefrac.geometry import triples
from torchrefrac.optim import Quadratic, SmallReport, minimize_each
from torchrefrac.refinement.epipolar import EpipolarError, Views, epipolar_error, epipolar_jacobian, meeting_points
from torchrefrac.refinement.priors import prior_costs, with_priors
from torchrefrac.refinement.tilt import tilted_rotation, turn_by_tilt

HEADING, CENTER, UNKNOWNS = 4, slice(5, 8), 8
TENSORS = ("plane1", "plane2", "cam_from_level", "focal", "index_ratio")


@dataclass(frozen=True)
class TwoViews:
    """N matches of two cameras: ideal image coordinates plane1, plane2 (N, 2), cam_from_level (2, 3, 3) from the
    measured verticals, focal (2) in pixels, index_ratio (scalar), and the height of the first camera.

    gravity_sigma: expected error of a vertical in radians; 0 takes them for exact, infinity leaves the tilts free.
    pixel_sigma weighs pixels against it. known_heading: in radians, where it was measured too.
    """

    plane1: Tensor
    plane2: Tensor
    cam_from_level: Tensor
    focal: Tensor
    index_ratio: Tensor
    height: float = 1.0
    gravity_sigma: float = 0.0
    pixel_sigma: float = 0.5
    known_heading: float | None = None

    def __len__(self) -> int:
        return len(self.plane1)

    def rows(self, rows: Tensor) -> "TwoViews":
        """Some of the matches."""
        return replace(self, plane1=self.plane1[rows], plane2=self.plane2[rows])

    def single(self) -> "TwoViews":
        """The same in single precision: enough to tell hypotheses apart."""
        return replace(self, **{name: getattr(self, name).float() for name in TENSORS})

    def errors(self, models: Tensor) -> EpipolarError:
        """Epipolar errors (H, N) in pixels under models (H, 8), and the depths at which the rays meet."""
        return epipolar_error(*self.views(models), self._focal, self.index_ratio)

    def squared_errors(self, models: Tensor) -> Tensor:
        """Squared epipolar errors (H, N) in pixels; inf where the rays do not meet below the water."""
        errors = self.errors(models)
        return torch.where(errors.possible, errors.error.square(), torch.inf)

    def points(self, models: Tensor) -> Tensor:
        """Points (H, N, 3): half way between the two rays of each match where they pass each other."""
        return meeting_points(*self.views(models), self.index_ratio)

    def costs(self, models: Tensor, max_error: float) -> Tensor:
        """Truncated sums (H) of squared errors in pixels, and the prior on the tilts.

        Matches whose rays do not meet below the water, or not at the depth of the bulk, count as outliers.
        """
        errors = self.errors(models)
        limit = max_error * max_error
        inside = errors.possible & _bulk(errors, max_error)
        cost = torch.where(inside, errors.error.square(), limit).clamp(max=limit).sum(dim=-1)
        return cost + 2.0 * prior_costs(models, self.gravity_sigma, self.pixel_sigma)

    def poses(self, models: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (H, 2, 3, 3) cam_from_world and centres (H, 2, 3) of both cameras."""
        rotation = tilted_rotation(self.cam_from_level, *self._angles(models))
        first = models.new_tensor((0.0, 0.0, self.height)).expand(len(models), 3)
        return rotation, torch.stack((first, models[:, CENTER]), dim=1)

    def views(self, models: Tensor) -> tuple[Views, Views]:
        """Both cameras of models (H, 8); the first one as a batch of 1 where all models share it."""
        rotation, center = self.poses(models)
        rows, components = triples.rows(rotation[..., None, :, :]), triples.split(center[..., None, :])
        count = 1 if _share_first(models) else len(models)
        one, two = (
            Views(
                tuple(tuple(entry[:n, k] for entry in row) for row in rows),  # type: ignore[arg-type]
                tuple(entry[:n, k] for entry in components),  # type: ignore[arg-type]
                self._planes[k],
            )
            for k, n in ((0, count), (1, len(models)))
        )
        return one, two

    def refine(self, models: Tensor, max_error: float, max_iterations: int, tolerance: float = 1e-6) -> SmallReport:
        """Minimise the truncated cost from models (K, 8); matches beyond max_error do not count."""
        problem = _Truncated(self, max_error, _bulk(self.errors(models), max_error))
        return minimize_each(problem, models, max_iterations, tolerance)

    def linearize(self, models: Tensor, max_error: float, active: Tensor) -> Quadratic:
        """The cost in squared pixels, half a sum, and its quadratic model in the eight unknowns."""
        by = epipolar_jacobian(*self.views(models), self._focal, self.index_ratio)
        error, limit = by.error, max_error * max_error
        inside = active & (error.abs() < max_error)
        weight = inside.to(error.dtype)
        cost = 0.5 * torch.where(inside, error.square(), limit).sum(dim=-1)
        jacobian = torch.stack((*by.turn[0], *by.turn[1], *by.center[1]), dim=1) * weight[:, None]
        chart = self._chart(models)
        hessian = chart.mT @ (jacobian @ jacobian.mT) @ chart
        gradient = (chart.mT @ (jacobian @ (weight * error)[..., None]))[..., 0]
        quadratic = Quadratic(cost, gradient, hessian)
        return with_priors(models, quadratic, self.gravity_sigma, self.pixel_sigma, self.known_heading is not None)

    def _angles(self, models: Tensor) -> tuple[Tensor, Tensor]:
        """Tilts (H, 2, 2) and headings (H, 2) of both cameras."""
        heading = models[:, HEADING]
        return models[:, :HEADING].unflatten(-1, (2, 2)), torch.stack((torch.zeros_like(heading), heading), dim=-1)

    def _chart(self, models: Tensor) -> Tensor:
        """Derivative (K, 9, 8) of the turns of both cameras and the second centre in the unknowns."""
        turns = turn_by_tilt(*self._angles(models))
        chart = models.new_zeros(len(models), 9, UNKNOWNS)
        chart[:, 0:3, 0:2] = turns[:, 0, :, :2]
        chart[:, 3:6, 2:5] = turns[:, 1]
        chart[:, 6:9, CENTER] = torch.eye(3, dtype=models.dtype, device=models.device)
        return chart

    @cached_property
    def _planes(self) -> tuple[tuple[Tensor, Tensor], ...]:
        return tuple(tuple(triples.components(plane)) for plane in (self.plane1, self.plane2))  # type: ignore[misc]

    @cached_property
    def _focal(self) -> tuple[Tensor, Tensor]:
        return self.focal[0], self.focal[1]


def _share_first(models: Tensor) -> bool:
    """Whether all models have the same first camera, whose rays are then followed once: those of minimal samples do."""
    if models.is_cuda or torch.compiler.is_compiling() or models.requires_grad or is_wrapped(models):
        return False  # there the numbers cannot be looked at, or only at a price, or each model has its own gradient
    return bool((models[:, :2] == models[:1, :2]).all())


def _bulk(errors: EpipolarError, max_error: float) -> Tensor:
    """Which matches (H, N) lie within the depths of the middle 80 % of those within max_error, three times as wide."""
    near = torch.where(errors.error.abs() < max_error, errors.depth, torch.nan)
    low, high = torch.nanquantile(near, near.new_tensor((0.1, 0.9)), dim=-1, keepdim=True)
    span = high - low
    return (errors.depth >= low - span) & (errors.depth <= high + span)


@dataclass(frozen=True)
class _Truncated:
    views: TwoViews
    max_error: float
    active: Tensor

    def linearize(self, states: Tensor) -> Quadratic:
        return self.views.linearize(states, self.max_error, self.active)
