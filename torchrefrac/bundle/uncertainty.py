"""Standard deviations and covariances of an adjusted scene."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.bundle.common_errors import CommonErrors, common_errors
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.point_noise import point_variances
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.optim import Covariance, ReducedCovariance, robust
from torchrefrac.optim.loss import radial_curvature
from torchrefrac.scene import Scene, largest_deviation

SYSTEMATIC, CELLS = 0.005, 4
"""Pixels: errors that change slowly over each image, by as many cells, and that no residual shows: what detection of
keypoints leaves. Measured on rendered riverbeds, whose keypoints are independent otherwise and right in the mean."""
MOST_TAKEN = 0.99
"""Share of the numbers measured that unknowns can take."""


@dataclass(frozen=True)
class Uncertainty:
    """How well what came out of an adjustment is known; lengths in the unit of the scene.

    pixel_sigma: the standard deviation of a keypoint's coordinate, pixels, of the typical point; effective_sigma:
    that of independent ones that would know as little of cameras and water.

    pose: covariances of (w, dc), R <- exp([w]x) R, radians, and of the centre. points: covariances, with all that
    cameras, water and the errors of the model add; relative: without that, as if cameras and water were known.
    intrinsics: by name of what was refined, standard deviations. index_ratio and planes: standard deviations, of planes
    of the two tilts (radians) and the height; zero where fixed. If the gauge was free these are relative to it (inner
    constraints on the views). reduced: of the reduced unknowns; layout: where they are. common: the errors that
    observations have in common, where the residuals show any; they are in all of these.
    """

    pixel_sigma: float
    effective_sigma: float
    pose: Float[Tensor, "m 6 6"]
    points: Float[Tensor, "n 3 3"]
    relative: Float[Tensor, "n 3 3"]
    intrinsics: dict[str, Float[Tensor, "cameras width"]]
    index_ratio: Float[Tensor, ""]
    planes: Float[Tensor, "interfaces 3"]
    reduced: ReducedCovariance
    layout: Layout
    common: CommonErrors | None = None

    def medium_sigma(self, name: str) -> float:
        """Standard deviation of one of `rows.MEDIA`, which varies."""
        column = self.layout.camera.new_tensor(self.layout.medium_column(name))
        return float(self.reduced[column, column].clamp(min=0.0).sqrt())

    @property
    def covariance(self) -> Float[Tensor, "size size"]:
        """`reduced` as a matrix. Raises SingularError where there are too many unknowns for one."""
        return self.reduced.matrix()

    @property
    def growth(self) -> float:
        """By how much errors that observations have in common make the deviations of the centres larger: of the median
        view."""
        independent = self.effective_sigma / self.pixel_sigma if self.pixel_sigma > 0.0 else 1.0
        if self.common is None:
            return independent
        every = self.pose.diagonal(dim1=1, dim2=2)[:, 3:].sum(dim=-1)
        common = self.common.poses(self.layout.num_views)[..., 3:].square().sum(dim=-1).mean(dim=0)
        others = (every - common).clamp(min=1e-6 * every.max())
        common_growth = float((every[others > 0.0] / others[others > 0.0]).median().sqrt()) if others.any() else 1.0
        return common_growth * independent

    @property
    def point_sigma(self) -> Float[Tensor, " n"]:
        """Standard deviation of the points along the axis in which each is known worst."""
        return largest_deviation(self.points)


def uncertainty(problem: BundleProblem, scene: Scene, pixel_sigma: float | None = None) -> Uncertainty:
    """Covariances at the minimum `scene` of `problem`, to first order.

    pixel_sigma: known noise of a keypoint's coordinate, of all points and independent. By default it is estimated from
    the residuals: of all, for what points have in common (a robust loss changes the noise that is effective, by the
    factor of M-estimators, Huber and Ronchetti, "Robust statistics", 2009, section 7.6, here for residuals of two
    coordinates); of each point, for its own part (`point_variances`); for cameras and water a small error counts that
    parts of each image have in common (`SYSTEMATIC`); and what neighbouring residuals have in common is added
    (`common_errors`). All observations count fully. Raises SingularError where the data do not determine the
    unknowns, or these are too many.
    """
    options, layout = problem.options, problem.layout
    sigma = estimate_pixel_sigma(problem, scene) if pixel_sigma is None else pixel_sigma
    effective = sigma if pixel_sigma is not None else sigma * _design_effect(problem, sigma) ** 0.5
    plain = replace(problem, options=replace(options, loss="squared", pixel_sigma=effective))
    found = Covariance.of(plain.linearize(scene).system)
    reduced = found.among.times(effective**2)
    covariance, residuals = replace(found, among=reduced), problem.errors(scene, problem.seen)
    points = residuals.new_zeros(layout.num_points, 3, 3)
    relative = points.clone()
    if not layout.fix_points:
        variance = _own_variances(problem, residuals, pixel_sigma)
        points[layout.eliminated_points] = covariance.eliminated(variance)
        relative[layout.eliminated_points] = covariance.own(variance)
    if layout.reduced is not None:
        columns = layout.point_columns(layout.reduced_points)
        points[layout.reduced_points] = reduced[columns[:, :, None], columns[:, None, :]]
        relative[layout.reduced_points] = points[layout.reduced_points]
    common = None if pixel_sigma is not None else common_errors(problem, scene, residuals, found.inverse)
    if common is not None:
        reduced = reduced.plus(common.reduced)
        points = points + torch.einsum("dni,dnj->nij", common.points, common.points) / len(common.points)
    every = torch.arange(layout.size, device=residuals.device)
    poses = every[: 6 * layout.num_views].view(-1, 6)
    deviation = torch.nn.functional.pad(reduced[every, every].clamp(min=0.0).sqrt(), (0, 1))
    return Uncertainty(
        pixel_sigma=sigma,
        effective_sigma=effective,
        pose=reduced[poses[:, :, None], poses[:, None, :]],
        points=points,
        relative=relative,
        intrinsics={name: deviation[layout.intrinsics_columns(name, layout.cameras)] for name in layout.intrinsics},
        index_ratio=deviation[layout.medium_column("index_ratio")],
        planes=deviation[layout.plane_columns(layout.interfaces)],
        reduced=reduced,
        layout=layout,
        common=common,
    )


def _design_effect(problem: BundleProblem, sigma: float) -> float:
    """By how much SYSTEMATIC raises the variance of a mean over n observations that have it in common, over that of
    independent ones: 1 + (n - 1) rho (Kish, "Survey sampling", 1965, section 8.2)."""
    together = len(problem.seen) / max(CELLS * problem.layout.num_views, 1)
    shared = SYSTEMATIC**2 / (SYSTEMATIC**2 + sigma**2) if sigma > 0.0 else 1.0
    return 1.0 + max(together - 1.0, 0.0) * shared


def _own_variances(
    problem: BundleProblem, residuals: Float[Tensor, "2 k"], pixel_sigma: float | None
) -> Float[Tensor, " p"]:
    """Variances of the keypoints of the points that are eliminated, square pixels. residuals: of `problem.seen`."""
    plan = problem.plan
    if pixel_sigma is not None:
        return residuals.new_full((len(plan.place_of),), pixel_sigma**2)
    share = problem.reduced_unknowns / max(2 * (len(problem.seen) + len(problem.seen_reduced)), 1)
    square = residuals.square().sum(dim=0)
    return point_variances(square, plan.place, plan.num_places, min(share, MOST_TAKEN))[plan.place_of]


def estimate_pixel_sigma(problem: BundleProblem, scene: Scene) -> float:
    """The effective standard deviation of a keypoint's coordinate, pixels, from the residuals at a minimum."""
    options = problem.options
    square = problem.squared_errors(scene)
    _, weight = robust(square, options.loss, options.loss_scale)
    turned = 0.5 * (weight.square() * square).sum()
    taken = min(problem.unknowns_per_residual, MOST_TAKEN)
    slopes = torch.stack((radial_curvature(weight, options.loss), weight))  # of the weighted residual, along and across
    mean = slopes.mean()
    fitted = 1.0 + taken * (slopes - mean).square().mean() / mean.square()  # K of Huber and Ronchetti, section 7.6
    variance = turned / (len(square) * (1.0 - taken)) * (fitted / mean).square()
    return float(variance.sqrt())
