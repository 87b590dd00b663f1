"""Refinement of the relative pose of two cameras above water: both tilts, heading and centre, all points eliminated.

A model is a row of eight numbers: the tilt of the first camera (2) and of the second (2) against the measured verticals
(see `tilt`), the heading of the second camera, and its centre (3), where the first camera stands at (0, 0, height) with
heading 0. The cost is half the sum of squared epipolar errors in pixels (see `epipolar`), truncated, plus gravity as a
prior on the tilts. To first order in the noise it is the bundle adjustment of both cameras and all points.

A wrong match that happens to lie near its epipolar curve implies a depth anywhere along it. Near nadir the pose has
weak directions in which a few of these can pull it away by many standard deviations, so that the fit is left to matches
whose depth is not far from that of the bulk.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import can_be_looked_at
from torchrefrac.geometry import triples
from torchrefrac.minimal import triangulate
from torchrefrac.minimal.rays import require_matches
from torchrefrac.optim import Quadratic, SmallReport, minimize_each
from torchrefrac.refinement.data import Costs, PoseData
from torchrefrac.refinement.epipolar import EpipolarError, Pair, Views, epipolar_error, epipolar_jacobian, rays_in_water
from torchrefrac.refinement.tilt import (
    Limit,
    Sigma,
    beside,
    tilted_rotation,
    turn_by_tilt,
)

HEADING, CENTER, UNKNOWNS = 4, slice(5, 8), 8
Models = Float[Tensor, "h 8"]


@dataclass(frozen=True)
class TwoViews(PoseData[EpipolarError]):
    """Matches of two cameras: ideal image coordinates plane1, plane2, cam_from_level from the measured verticals, focal
    in pixels, of both or of each, and the height of the first camera, in the unit of the pose. Of one pair or of many
    (see `PoseData`).

    gravity_sigma: expected error of a vertical in radians; 0 takes them for exact, infinity leaves the tilts free.
    pixel_sigma weighs pixels against it. known_heading: in radians, where it was measured too.
    """

    DATA, UNKNOWNS = ("plane1", "plane2"), UNKNOWNS

    plane1: Float[Tensor, "*own n 2"]
    plane2: Float[Tensor, "*own n 2"]
    cam_from_level: Float[Tensor, "*own 2 3 3"]
    focal: Float[Tensor, "*own_view 2"]
    index_ratio: Float[Tensor, ""]
    height: float = 1.0
    gravity_sigma: Sigma = 0.0
    pixel_sigma: float = 0.5
    known_heading: Sigma | None = None
    exists: Bool[Tensor, "own n"] | None = None

    def __post_init__(self) -> None:
        if self.plane1.dim() != 3:
            require_matches(self.plane1, plane2=self.plane2)

    def errors(self, models: Models) -> EpipolarError:
        """Epipolar errors in pixels, and the depths at which the rays meet."""
        found = epipolar_error(*self.views(models), self.index_ratio)
        if self.exists is None:
            return found
        return found._replace(error=torch.where(self.exists, found.error, torch.inf), down=found.down & self.exists)

    def points(self, models: Models) -> Float[Tensor, "h n 3"]:
        """Points next to both rays of each match."""
        rays = zip(*(rays_in_water(view, self.index_ratio) for view in self.views(models)), strict=True)
        return triangulate(*(torch.stack(torch.broadcast_tensors(*pair), dim=-2) for pair in rays))[0]

    def costs_of(self, errors: EpipolarError, max_error: Limit) -> Float[Tensor, " h"]:
        """Truncated sums of squared errors in pixels. Matches whose rays do not meet below the water, or not at the
        depth of the bulk, count as outliers."""
        limit = beside(max_error, errors.error) ** 2
        inside = errors.possible & _bulk(errors, max_error)
        return self._sum(torch.where(inside, errors.error.square(), limit).minimum(limit))

    def poses(self, models: Models) -> tuple[Float[Tensor, "h 2 3 3"], Float[Tensor, "h 2 3"]]:
        """Rotations cam_from_world and centres of both cameras."""
        rotation = tilted_rotation(self.cam_from_level, *self._angles(models))
        first = models.new_zeros(3)
        first[2] = self.height
        return rotation, torch.stack((first.expand(len(models), 3), models[:, CENTER]), dim=1)

    def views(self, models: Models) -> tuple[Views, Views]:
        """Both cameras of models; the first one as a batch of 1 where all models share it."""
        rotation, center = self.poses(models)
        rows, components = triples.rows(rotation[..., None, :, :]), triples.split(center[..., None, :])
        count = 1 if self.plane1.dim() == 2 and _share_first(models) else len(models)
        one, two = (
            Views(
                tuple(tuple(entry[:n, k] for entry in row) for row in rows),  # type: ignore[arg-type]
                tuple(entry[:n, k] for entry in components),  # type: ignore[arg-type]
                self._planes[k],
                self._focal[k],
            )
            for k, n in ((0, count), (1, len(models)))
        )
        return one, two

    def refine(self, models: Models, max_error: Limit, max_iterations: int, tolerance: float = 1e-6) -> SmallReport:
        """Minimise the truncated cost from models; matches beyond max_error do not count."""
        active = _bulk(self.errors(models), max_error)
        return minimize_each(Costs(self, max_error, active), models, max_iterations, tolerance)

    def linearize(self, models: Models, max_error: Limit, active: Bool[Tensor, "h n"] | None = None) -> Quadratic:
        """The cost in squared pixels, half a sum, and its quadratic model in the eight unknowns."""
        by = epipolar_jacobian(*self.views(models), self.index_ratio)
        error, widest = by.error, beside(max_error, by.error)
        inside = error.abs() < widest
        for counts in (active, self.exists):
            inside = inside if counts is None else inside & counts
        weight = inside.to(error.dtype)
        cost = 0.5 * self._sum(torch.where(inside, error.square(), widest**2))
        jacobian = torch.stack([part * weight for part in (*by.turn[0], *by.turn[1], *by.center[1])], dim=1)
        chart = self._chart(models)
        hessian = chart.mT @ (jacobian @ jacobian.mT) @ chart
        weighted = torch.where(inside, error, 0.0)
        gradient = (chart.mT @ (jacobian @ weighted[..., None]))[..., 0]
        return self.priors.added_to(Quadratic(cost, gradient, hessian), models)

    def _angles(self, models: Models) -> tuple[Float[Tensor, "h 2 2"], Float[Tensor, "h 2"]]:
        """Tilts and headings of both cameras."""
        heading = models[:, HEADING]
        return models[:, :HEADING].unflatten(-1, (2, 2)), torch.stack((torch.zeros_like(heading), heading), dim=-1)

    def _chart(self, models: Models) -> Float[Tensor, "h 9 8"]:
        """Derivative of the turns of both cameras and the second centre in the unknowns."""
        turns = turn_by_tilt(*self._angles(models))
        chart = models.new_zeros(len(models), 9, UNKNOWNS)
        chart[:, 0:3, 0:2] = turns[:, 0, :, :2]
        chart[:, 3:6, 2:5] = turns[:, 1]
        chart[:, 6:9, CENTER] = torch.eye(3, dtype=models.dtype, device=models.device)
        return chart

    @cached_property
    def _planes(self) -> list[Pair]:
        return [(x, y) for x, y in (triples.components(plane) for plane in (self.plane1, self.plane2))]

    @cached_property
    def _focal(self) -> list[Pair]:
        if self.focal.dim() == 3:
            return [(fx, fy) for fx, fy in (of_view[..., None].unbind(dim=1) for of_view in self.focal.unbind(dim=1))]
        return [(fx, fy) for fx, fy in self.focal.expand(2, 2)]


def _share_first(models: Models) -> bool:
    """Whether all models have the same first camera, whose rays are then followed once: those of minimal samples do."""
    return can_be_looked_at(models) and bool((models[:, :2] == models[:1, :2]).all())


def _bulk(errors: EpipolarError, max_error: Limit) -> Bool[Tensor, "h n"]:
    """Which matches lie within the depths of the middle 80 % of those within max_error, three times as wide."""
    near = torch.where(errors.error.abs() < beside(max_error, errors.error), errors.depth, torch.nan)
    ends = torch.linspace(0.1, 0.9, 2, dtype=near.dtype, device=near.device)
    low, high = torch.nanquantile(near, ends, dim=-1, keepdim=True)
    span = high - low
    return (errors.depth >= low - span) & (errors.depth <= high + span)
