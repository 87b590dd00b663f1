"""Refinement of the pose of one camera above water that sees known points, in water or in air.

A model is a row of six numbers: the tilt (2) against the measured vertical (see `tilt`), the heading, the centre (3).
The cost is half the sum of squared reprojection errors in pixels, exact through the water, truncated, plus gravity as a
prior on the tilt.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.geometry import triples
from torchrefrac.geometry.triples import Part, Triple
from torchrefrac.minimal.rays import require_matches
from torchrefrac.optim import Quadratic, SmallReport, minimize_each
from torchrefrac.refinement.tilt import Cost, Limit, beside, prior_costs, tilted_rotation, turn_by_tilt, with_priors
from torchrefrac.refraction import apparent_height, apparent_height_partials, screening_height

TILT, HEADING, CENTER, UNKNOWNS = slice(0, 2), 2, slice(3, 6), 6
TENSORS = ("plane", "points", "cam_from_level", "focal", "index_ratio")
TINY = 1e-30
Models = Float[Tensor, "h 6"]


@dataclass(frozen=True)
class OneView:
    """Points in the world and their ideal image coordinates plane; cam_from_level from the measured vertical, focal in
    pixels. Lengths are in the unit of the points, the water is z = 0.

    gravity_sigma: expected error of the vertical in radians; 0 takes it for exact, infinity leaves the tilt free.
    pixel_sigma weighs pixels against it. known_heading: in radians, where it was measured too.
    """

    plane: Float[Tensor, "n 2"]
    points: Float[Tensor, "n 3"]
    cam_from_level: Float[Tensor, "3 3"]
    focal: Float[Tensor, " 2"]
    index_ratio: Float[Tensor, ""]
    gravity_sigma: float = 0.0
    pixel_sigma: float = 0.5
    known_heading: float | None = None

    def __post_init__(self) -> None:
        require_matches(self.plane, points=self.points)

    def __len__(self) -> int:
        return len(self.plane)

    def rows(self, rows: Shaped[Tensor, " some"]) -> "OneView":
        """Some of the points."""
        return replace(self, plane=self.plane[rows], points=self.points[rows])

    def single(self) -> "OneView":
        """The same in single precision: enough to tell hypotheses apart."""
        return replace(self, **{name: getattr(self, name).float() for name in TENSORS})

    def poses(self, models: Models) -> tuple[Float[Tensor, "h 3 3"], Float[Tensor, "h 3"]]:
        """Rotations cam_from_world and centres."""
        return tilted_rotation(self.cam_from_level, models[:, TILT], models[:, HEADING]), models[:, CENTER]

    def squared_errors(self, models: Models) -> Float[Tensor, "h n"]:
        """Squared reprojection errors in pixels; inf where a point cannot be seen."""
        rotation, center = self.poses(models)
        (ux, uy), height, depth = self._offsets(triples.split(center[:, None]))
        distance_sq = torch.addcmul(ux * ux, uy, uy)
        lifted = screening_height(distance_sq, height.clamp(min=TINY), depth.clamp(min=0.0), self.index_ratio)
        lifted = torch.where(depth > 0.0, lifted, height + depth)
        x, y, z = (_apply(row, (ux, uy, lifted)) for row in triples.rows(rotation[:, None]))
        inverse = z.reciprocal()
        (px, py), (fx, fy) = self._plane, self.focal
        u = torch.addcmul(px, x, inverse, value=-1.0) * fx
        v = torch.addcmul(py, y, inverse, value=-1.0) * fy
        return torch.where((z > 0.0) & (height > 0.0), torch.addcmul(u * u, v, v), torch.inf)

    def costs(self, models: Models, max_error: Limit) -> Float[Tensor, " h"]:
        """Truncated sums of squared errors in pixels, and the prior on the tilt."""
        squares = self.squared_errors(models)
        squares = squares.minimum(beside(max_error, squares) ** 2).sum(dim=-1)
        return squares + 2.0 * prior_costs(models, self.gravity_sigma, self.pixel_sigma)

    def refine(self, models: Models, max_error: Limit, max_iterations: int, tolerance: float = 1e-6) -> SmallReport:
        """Minimise the truncated cost from models; points beyond max_error do not count."""
        return minimize_each(Cost(lambda states: self.linearize(states, max_error)), models, max_iterations, tolerance)

    def linearize(self, models: Models, max_error: Limit) -> Quadratic:
        """The cost in squared pixels, half a sum, and its quadratic model in the six unknowns."""
        rotation, center = self.poses(models)
        (ux, uy), height, depth = self._offsets(triples.split(center[:, None]))
        wet = depth > 0.0
        terms = (torch.addcmul(ux * ux, uy, uy), height.clamp(min=TINY), (depth.clamp(min=0.0),), (self.index_ratio,))
        lifted = apparent_height(*terms)
        by = apparent_height_partials(lifted, *terms)
        lifted = torch.where(wet, lifted, height + depth)
        by_height = torch.where(wet, by.by_clear, 1.0)
        by_square = torch.where(wet, by.by_distance_sq, 0.0)
        rows = triples.rows(rotation[:, None])
        x, y, z = (_apply(row, (ux, uy, lifted)) for row in rows)
        ahead = (z > 0.0) & (height > 0.0)
        inverse = torch.where(ahead, z, 1.0).reciprocal()
        x, y = x * inverse, y * inverse
        residuals, jacobian = [], []
        for axis, at, seen, f in ((0, x, self._plane[0], self.focal[0]), (1, y, self._plane[1], self.focal[1])):
            residuals.append((at - seen) * f)
            scale = f * inverse
            g = triples.scaled(scale, triples.add_scaled(rows[axis], at, rows[2], sign=-1.0))
            jacobian.append(_of_pose(g, (ux, uy, lifted), by_height, by_square))
        square = residuals[0].square() + residuals[1].square()
        limit = beside(max_error, square) ** 2
        inside = ahead & (square < limit)
        weight = inside.to(square.dtype)
        cost = 0.5 * torch.where(inside, square, limit).sum(dim=-1)
        weighted = torch.cat([torch.stack(part, dim=1) * weight[:, None] for part in jacobian], dim=-1)
        residual = torch.cat(residuals, dim=-1) * torch.cat((weight, weight), dim=-1)
        chart = self._chart(models)
        hessian = chart.mT @ (weighted @ weighted.mT) @ chart
        gradient = (chart.mT @ (weighted @ residual[..., None]))[..., 0]
        quadratic = Quadratic(cost, gradient, hessian)
        return with_priors(models, quadratic, self.gravity_sigma, self.pixel_sigma, self.known_heading is not None)

    def _offsets(self, center: Triple) -> tuple[tuple[Part, Part], Part, Part]:
        """Horizontal offsets of the points from the centre, height of the camera and depth of the points."""
        px, py, pz = self._points
        return (px - center[0], py - center[1]), center[2], -pz

    def _chart(self, models: Models) -> Float[Tensor, "h 6 6"]:
        """Derivative of the turn of the camera and its centre in the unknowns."""
        chart = models.new_zeros(len(models), 6, UNKNOWNS)
        chart[:, 0:3, 0:3] = turn_by_tilt(models[:, TILT], models[:, HEADING])
        chart[:, 3:6, CENTER] = torch.eye(3, dtype=models.dtype, device=models.device)
        return chart

    @cached_property
    def _points(self) -> Triple:
        return triples.split(self.points)

    @cached_property
    def _plane(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        x, y = triples.components(self.plane)
        return x, y


def _apply(row: Triple, offset: Triple) -> Float[Tensor, "*batch"]:
    """One coordinate in the camera of an apparent offset (x, y, down)."""
    straight = torch.addcmul(row[0] * offset[0], row[1], offset[1])
    return torch.addcmul(straight, row[2], offset[2], value=-1.0)


def _of_pose(g: Triple, offset: Triple, by_height: Part, by_square: Part) -> tuple[Part, ...]:
    """Derivatives of a pixel coordinate in a turn about the axes of the world and in the centre.

    g: that in the apparent offset (x, y, z), whose z is -H; by_height, by_square: those of the apparent height H in the
    height of the camera and in the squared horizontal distance.
    """
    ux, uy, lifted = offset
    bend = 2.0 * by_square * g[2]
    center = (torch.addcmul(-g[0], bend, ux), torch.addcmul(-g[1], bend, uy), -g[2] * by_height)
    return *triples.cross((ux, uy, -lifted), g), *center
