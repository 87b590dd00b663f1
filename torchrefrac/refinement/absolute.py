"""Refinement of the pose of one camera above water that sees known points, in water or in air.

A model is a row of six numbers: the tilt (2) against the measured vertical (see `tilt`), the heading, the centre (3).
The cost is half the sum of squared reprojection errors in pixels, exact through the water, truncated, plus gravity as a
prior on the tilt.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import triples
from torchrefrac.geometry.triples import Part, Triple
from torchrefrac.minimal.rays import require_matches
from torchrefrac.optim import Quadratic, SmallReport, minimize_each
from torchrefrac.refinement.data import Costs, PoseData
from torchrefrac.refinement.tilt import Limit, Sigma, beside, tilted_rotation, turn_by_tilt
from torchrefrac.refraction import apparent_height_partials, screening_height

TILT, HEADING, CENTER, UNKNOWNS = slice(0, 2), 2, slice(3, 6), 6
TINY = 1e-30
Models = Float[Tensor, "h 6"]


class ReprojectionError(NamedTuple):
    """Squared, in pixels."""

    squared: Float[Tensor, "h n"]


@dataclass(frozen=True)
class OneView(PoseData[ReprojectionError]):
    """Points in the world and their ideal image coordinates plane; cam_from_level from the measured vertical, focal in
    pixels. Of one view or of many (see `PoseData`). Lengths are in the unit of the points, the water is z = 0.

    gravity_sigma: expected error of the vertical in radians; 0 takes it for exact, infinity leaves the tilt free.
    pixel_sigma weighs pixels against it. known_heading: in radians, where it was measured too.
    """

    DATA, UNKNOWNS = ("plane", "points"), UNKNOWNS

    plane: Float[Tensor, "*own n 2"]
    points: Float[Tensor, "*own n 3"]
    cam_from_level: Float[Tensor, "*own 3 3"]
    focal: Float[Tensor, "*own 2"]
    index_ratio: Float[Tensor, ""]
    gravity_sigma: Sigma = 0.0
    pixel_sigma: float = 0.5
    known_heading: Sigma | None = None
    exists: Bool[Tensor, "own n"] | None = None

    def __post_init__(self) -> None:
        if self.plane.dim() != 3:
            require_matches(self.plane, points=self.points)

    def poses(self, models: Models) -> tuple[Float[Tensor, "h 3 3"], Float[Tensor, "h 3"]]:
        """Rotations cam_from_world and centres."""
        return tilted_rotation(self.cam_from_level, models[:, TILT], models[:, HEADING]), models[:, CENTER]

    def errors(self, models: Models) -> ReprojectionError:
        """Reprojection errors; infinite where a point cannot be seen."""
        rotation, center = self.poses(models)
        (ux, uy), height, depth = self._offsets(triples.split(center[:, None]))
        distance_sq = torch.addcmul(ux * ux, uy, uy)
        lifted = screening_height(distance_sq, height.clamp(min=TINY), depth.clamp(min=0.0), self.index_ratio)
        lifted = torch.where(depth > 0.0, lifted, height + depth)
        x, y, z = triples.rotated(triples.rows(rotation[:, None]), (ux, uy, -lifted))
        inverse = z.reciprocal()
        (px, py), (fx, fy) = self._plane, self._focal
        u = torch.addcmul(px, x, inverse, value=-1.0) * fx
        v = torch.addcmul(py, y, inverse, value=-1.0) * fy
        possible = (z > 0.0) & (height > 0.0)
        possible = possible if self.exists is None else possible & self.exists
        return ReprojectionError(torch.where(possible, torch.addcmul(u * u, v, v), torch.inf))

    def costs_of(self, errors: ReprojectionError, max_error: Limit) -> Float[Tensor, " h"]:
        """Truncated sums of squared errors in pixels."""
        return self._sum(errors.squared.minimum(beside(max_error, errors.squared) ** 2))

    def refine(self, models: Models, max_error: Limit, max_iterations: int, tolerance: float = 1e-6) -> SmallReport:
        """Minimise the truncated cost from models; points beyond max_error do not count."""
        return minimize_each(Costs(self, max_error), models, max_iterations, tolerance)

    def linearize(self, models: Models, max_error: Limit, active: Bool[Tensor, "h n"] | None = None) -> Quadratic:
        """The cost in squared pixels, half a sum, and its quadratic model in the six unknowns."""
        rotation, center = self.poses(models)
        (ux, uy), height, depth = self._offsets(triples.split(center[:, None]))
        wet = depth > 0.0
        distance_sq, clear, water = torch.addcmul(ux * ux, uy, uy), height.clamp(min=TINY), depth.clamp(min=0.0)
        lifted = screening_height(distance_sq, clear, water, self.index_ratio)
        by = apparent_height_partials(lifted, distance_sq, clear, (water,), (self.index_ratio,))
        by_height = torch.where(wet, by.by_clear, 1.0)
        bend = torch.where(wet, 2.0 * by.by_distance_sq, 0.0)
        offset = (ux, uy, -torch.where(wet, lifted, height + depth))
        rows = triples.rows(rotation[:, None])
        x, y, z = triples.rotated(rows, offset)
        ahead = (z > 0.0) & (height > 0.0)
        inverse = torch.where(ahead, z, 1.0).reciprocal()
        at = x * inverse, y * inverse
        residuals = [(a - seen) * f for a, seen, f in zip(at, self._plane, self._focal, strict=True)]
        square = torch.addcmul(residuals[0] * residuals[0], residuals[1], residuals[1])
        limit = beside(max_error, square) ** 2
        inside = ahead & (square < limit)
        for counts in (active, self.exists):
            inside = inside if counts is None else inside & counts
        cost = 0.5 * self._sum(torch.where(inside, square, limit))
        weighted = torch.where(inside, inverse, 0.0)
        by_axis = [
            _of_pose(
                triples.scaled(weighted * f, triples.add_scaled(row, a, rows[2], sign=-1.0)), offset, by_height, bend
            )
            for row, a, f in zip(rows[:2], at, self._focal, strict=True)
        ]
        jacobian = torch.stack([of_axis[i] for i in range(UNKNOWNS) for of_axis in by_axis], dim=1)
        jacobian = jacobian.unflatten(1, (UNKNOWNS, 2)).flatten(-2)
        residual = torch.stack(residuals, dim=1).flatten(-2)
        chart = self._chart(models)
        hessian = chart.mT @ (jacobian @ jacobian.mT) @ chart
        gradient = (chart.mT @ (jacobian @ residual[..., None]))[..., 0]
        return self.priors.added_to(Quadratic(cost, gradient, hessian), models)

    def _offsets(self, center: Triple) -> tuple[tuple[Part, Part], Part, Part]:
        """Horizontal offsets of the points from the centre, height of the camera and depth of the points."""
        px, py, pz = self._points
        return (px - center[0], py - center[1]), center[2], -pz

    def _chart(self, models: Models) -> Float[Tensor, "h 6 6"]:
        """Derivative of the turn of the camera, and of minus its centre, in the unknowns."""
        chart = models.new_zeros(len(models), 6, UNKNOWNS)
        chart[:, 0:3, 0:3] = turn_by_tilt(models[:, TILT], models[:, HEADING])
        chart[:, 3:6, CENTER] = -torch.eye(3, dtype=models.dtype, device=models.device)
        return chart

    @cached_property
    def _points(self) -> Triple:
        return triples.split(self.points)

    @cached_property
    def _plane(self) -> tuple[Part, Part]:
        x, y = triples.components(self.plane)
        return x, y

    @cached_property
    def _focal(self) -> tuple[Part, Part]:
        fx, fy = self.focal[..., None].unbind(dim=-2)
        return fx, fy


def _of_pose(g: Triple, offset: Triple, by_height: Part, bend: Part) -> tuple[Part, ...]:
    """Derivatives of a pixel coordinate in a turn about the axes of the world and in minus the centre.

    g: that in the apparent offset, whose last component is minus the apparent height; by_height: the derivative of that
    height in the one of the camera, bend: twice that in the squared horizontal distance.
    """
    bent = bend * g[2]
    center = (
        torch.addcmul(g[0], bent, offset[0], value=-1.0),
        torch.addcmul(g[1], bent, offset[1], value=-1.0),
        g[2] * by_height,
    )
    return *triples.cross(offset, g), *center
