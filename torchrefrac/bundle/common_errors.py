"""Errors that neighbouring observations have in common, because the model is not true: waves on the water, a lens that
is not what its intrinsics say. Noise averages out over a thousand observations; these do not.

How large they are follows from the residuals by estimation of variance components (Rao, "Estimation of variance and
covariance components - MINQUE theory", 1971; Teunissen and Amiri-Simkooei, "Least-squares variance component
estimation", 2008). Each kind of error is a random field with a length over which it changes. Products of residuals,
summed over the pairs of observations within cells of several sizes, are set against what fields of variance one leave
in the same sums once the adjustment has absorbed what it can; the variances are the non-negative ones that explain
them best. Fields are drawn rather than written down as covariances: each draw goes through the linearised adjustment
once, as a right-hand side. What draws of the explained variances do to the unknowns is the covariance that is added.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.random_fields import random_gradient, random_shift
from torchrefrac.bundle.surface_slope import surface_slope
from torchrefrac.numerics import segment_sum_columns, typical_deviation
from torchrefrac.optim import REDUCED_SIZE, GaussNewtonInverse
from torchrefrac.scene import Scene

PARTS = (2.0, 6.0, 20.0, 64.0)
"""Cells are such parts of the width of an image, or of what an image sees of the surface."""
SEEN = 8.0
"""Standard deviations of a sum over independent residuals beyond which there are common errors."""
CLIP = 3.0
"""Standard deviations beyond which a residual counts no more: a wrong match is no field."""
TRIALS, MOST_TRIALS, ENOUGH = 3, 12, 100_000
"""How many draws tell what a field leaves in the residuals: more where there are fewer than so many observations in
all, which are soon drawn."""
DRAWS = 40
"""How many tell what all fields together do to the unknowns."""
TOLERANCE = 0.1
"""Relative error of a sum that an explanation by fields is allowed."""


@dataclass(frozen=True)
class CommonErrors:
    """What errors that observations have in common do to an adjustment.

    reduced, points: draws of the changes of the unknowns, whose mean square is the covariance that is added.

    still_slope, moving_slope: root mean square slope (length of the gradient, radians) of a surface that is the same
    for all images, and of one that differs from image to image. lens: error of a coordinate that images of a camera
    have in common, pixels.
    """

    reduced: Float[Tensor, "draws size"]
    points: Float[Tensor, "draws n 3"]
    still_slope: float
    moving_slope: float
    lens: float

    @property
    def slope(self) -> float:
        """Root mean square slope of the surface, radians."""
        return math.hypot(self.still_slope, self.moving_slope)

    def poses(self, views: int) -> Float[Tensor, "draws {views} 6"]:
        """The draws of (w, dc) of so many views."""
        return self.reduced[:, : REDUCED_SIZE * views].view(-1, views, REDUCED_SIZE)

    def tilt(self, views: int) -> Float[Tensor, "{views}"]:
        """Standard deviation of the vertical in each of so many views, radians about an axis across it."""
        return self.poses(views)[..., :3].square().mean(dim=(0, 2)).sqrt()


@dataclass(frozen=True)
class _Kind:
    """Fields over `place`, one for each group of observations. by_value: derivative of pixels in the gradient that the
    field is; None for a field of pixels. precision: one over the noise of the pixels, by which errors are divided.
    extent: what cells are parts of."""

    place: Float[Tensor, "k 2"]
    group: Int[Tensor, " k"]
    extent: float
    precision: Float[Tensor, "*k"]
    by_value: Float[Tensor, "k 2 2"] | None = None

    def draw(self, part: float, generator: torch.Generator) -> Float[Tensor, "2 k"]:
        """Pixel errors over their noise by a field of variance one that changes over half a cell."""
        length = 0.5 * self.extent / part
        if self.by_value is None:
            return random_shift(self.place, self.group, length, generator) * self.precision
        gradient = random_gradient(self.place, self.group, length, generator)
        return torch.einsum("kis,sk->ik", self.by_value, gradient) * self.precision

    @cached_property
    def cells(self) -> list[tuple[Int[Tensor, " k"], int]]:
        """The cell of each observation, and how many there are, for each of the parts."""
        found = []
        for part in PARTS:
            at = (self.place / (self.extent / part)).floor().long()
            at = at - at.amin(dim=0)
            code = (self.group * (at[:, 0].max() + 1) + at[:, 0]) * (at[:, 1].max() + 1) + at[:, 1]
            codes, cell = torch.unique(code, return_inverse=True)
            found.append((cell, len(codes)))
        return found

    def sums(self, residuals: Float[Tensor, "2 k"]) -> list[Float[Tensor, ""]]:
        """Products of different residuals, as the values of the field would see them, over the pairs in each cell."""
        return list(self._pair_sums(self._scores(residuals)))

    def spreads(self, residuals: Float[Tensor, "2 k"]) -> list[Float[Tensor, ""]]:
        """Standard deviations of these sums where residuals are independent."""
        squares = self._scores(residuals).square()
        return [(2.0 * total).clamp(min=0.0).sqrt() for total in self._pair_sums(squares)]

    def _pair_sums(self, values: Float[Tensor, "2 k"]) -> Iterator[Float[Tensor, ""]]:
        """Products of different values of a component, over the pairs in each cell."""
        alone = values.square().sum()
        for cell, count in self.cells:
            yield segment_sum_columns(values, cell, count).square().sum() - alone

    def _scores(self, residuals: Float[Tensor, "2 k"]) -> Float[Tensor, "2 k"]:
        precise = residuals * self.precision
        return precise if self.by_value is None else torch.einsum("kis,ik->sk", self.by_value, precise)


def common_errors(
    problem: BundleProblem, scene: Scene, residuals: Float[Tensor, "2 k"], inverse: GaussNewtonInverse
) -> CommonErrors | None:
    """Those that the residuals of `problem.seen` at the minimum `scene` show; None where they look independent.

    inverse: that of the problem with a squared loss. Deterministic. Errors whose fields change over less than a
    hundredth of an image look independent, and those that the adjustment absorbs altogether are not seen.
    """
    if not residuals.numel() or problem.layout.fix_points:
        return None
    kinds = _kinds(problem, scene)
    length = residuals.square().sum(dim=0).sqrt()
    limit = CLIP * typical_deviation(length)
    clipped = residuals * (limit / length.clamp(min=torch.finfo(length.dtype).tiny)).clamp(max=1.0)
    seen = torch.stack([value for kind in kinds for value in kind.sums(clipped)])
    spread = torch.stack([value for kind in kinds for value in kind.spreads(clipped)])
    if not bool((seen > SEEN * spread).any()):
        return None
    generator = torch.Generator().manual_seed(0)
    fields = [(kind, part) for kind in kinds for part in PARTS]
    left = torch.stack([_left_by(field, kinds, inverse, generator) for field in fields], dim=1)
    variances = _explained(left, seen, TOLERANCE * seen.abs() + spread)
    explained = [(kind, part, variance) for (kind, part), variance in zip(fields, variances, strict=True) if variance]
    if not explained:
        return None
    lens, still, moving = (
        math.sqrt(sum(variance for kind, _, variance in explained if kind is one)) for one in (*kinds, None, None)[:3]
    )
    return CommonErrors(*_drawn(problem, explained, inverse), still_slope=still, moving_slope=moving, lens=lens)


def _kinds(problem: BundleProblem, scene: Scene) -> tuple[_Kind, ...]:
    """Errors of the lens; of a surface that stands still, and of one that moves, where there is one."""
    seen, views = problem.seen, scene.views
    widest, precision = float(max(width for width, _ in scene.cameras.sizes)), seen.precision
    lens = _Kind(seen.pixels, views.camera[seen.view], widest, precision)
    if not scene.interfaces.stand_in_world:
        return (lens,)
    slope = surface_slope(scene, seen)
    wet = (slope.by_slope != 0.0).any(dim=(1, 2))
    extent = _extent(slope.place[wet], seen.view[wet], len(views))
    if extent <= 0.0:
        return (lens,)
    still = _Kind(slope.place, views.interface[seen.view], extent, precision, slope.by_slope)
    return lens, still, _Kind(slope.place, seen.view, extent, precision, slope.by_slope)


def _extent(place: Float[Tensor, "k 2"], view: Int[Tensor, " k"], views: int) -> float:
    """How wide a square is on which places would spread as those of the median view do."""
    if not len(place):
        return 0.0
    count = torch.bincount(view, minlength=views)[:, None].clamp(min=1)
    mean = segment_sum_columns(place.T, view, views).T / count
    variance = segment_sum_columns((place - mean[view]).square().T, view, views).T / count
    used = variance.amax(dim=1)
    return math.sqrt(12.0 * float(used[used > 0.0].median())) if bool((used > 0.0).any()) else 0.0


def _left_by(
    field: tuple[_Kind, float], kinds: Sequence[_Kind], inverse: GaussNewtonInverse, generator: torch.Generator
) -> Float[Tensor, " sums"]:
    """The sums over what a field of variance one leaves in the residuals, in the mean of some draws."""
    kind, part = field
    total = kind.place.new_zeros(len(kinds) * len(PARTS))
    trials = min(max(TRIALS, ENOUGH // len(kind.place)), MOST_TRIALS)
    for _ in range(trials):
        _, _, left = inverse.propagate(kind.draw(part, generator))
        total += torch.stack([value for each in kinds for value in each.sums(left)])
    return total / trials


def _explained(
    left: Float[Tensor, "sums fields"], seen: Float[Tensor, " sums"], spread: Float[Tensor, " sums"]
) -> list[float]:
    """The variances of fields that explain the sums best, by non-negative least squares. Sums over cells without a pair
    say nothing."""
    from scipy.optimize import nnls  # noqa: PLC0415 - slow to import

    usable = (spread > 0.0) & spread.isfinite() & left.isfinite().all(dim=1)
    if not bool(usable.any()):
        return [0.0] * left.shape[1]
    weighed = left[usable] / spread[usable, None], seen[usable] / spread[usable]
    solution, _ = nnls(*(values.cpu().numpy() for values in weighed))
    return solution.tolist()


def _drawn(
    problem: BundleProblem, explained: Sequence[tuple[_Kind, float, float]], inverse: GaussNewtonInverse
) -> tuple[Float[Tensor, "draws size"], Float[Tensor, "draws n 3"]]:
    """What draws of all fields (kind, part, variance) together do to the unknowns."""
    generator = torch.Generator().manual_seed(1)
    layout = problem.layout
    reduced, points = [], []
    for _ in range(DRAWS):
        fields = (math.sqrt(variance) * kind.draw(part, generator) for kind, part, variance in explained)
        step, eliminated, _ = inverse.propagate(torch.stack([*fields]).sum(dim=0))
        moved = eliminated.new_zeros(layout.num_points, 3)
        moved[layout.eliminated_points] = eliminated
        if layout.reduced is not None:
            moved[layout.reduced_points] = step[layout.point_columns(layout.reduced_points)]
        reduced.append(step)
        points.append(moved)
    return torch.stack(reduced), torch.stack(points)
