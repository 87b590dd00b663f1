"""Standard deviations and covariances of an adjusted scene."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.state import BundleState
from torchrefrac.optim import Covariance, LossName, robust


@dataclass(frozen=True)
class Uncertainty:
    """pixel_sigma: the standard deviation of a keypoint's coordinate, pixels, that all follow from.

    pose (m, 6, 6): covariances of (w, dc), R <- exp([w]x) R, radians, and of the centre. points (n, 3, 3). lens: by
    name of what was refined, standard deviations (G, width). index_ratio: scalar, planes (E, 3): of the two tilts
    (radians) and the height; zero where held. If the gauge was free these are relative to it (inner constraints on the
    cameras). covariance: of all reduced unknowns; layout: where they are.
    """

    pixel_sigma: float
    pose: Tensor
    points: Tensor
    lens: dict[str, Tensor]
    index_ratio: Tensor
    planes: Tensor
    covariance: Tensor
    layout: Layout

    @property
    def point_sigma(self) -> Tensor:
        """Standard deviation of the points (n), the root of the mean variance along an axis."""
        return self.points.diagonal(dim1=1, dim2=2).mean(dim=-1).clamp(min=0.0).sqrt()


def uncertainty(problem: BundleProblem, state: BundleState, pixel_sigma: float | None = None) -> Uncertainty:
    """Covariances at the minimum `state` of `problem`, to first order.

    pixel_sigma: known noise of a keypoint's coordinate; by default it is estimated from the residuals. All
    observations count fully: a robust loss changes the noise that is effective, by the factor of M-estimators (Huber
    and Ronchetti, "Robust statistics", 2009, section 7.6), here for residuals of two coordinates. Raises SingularError
    where the data do not determine the unknowns, or these are too many.
    """
    options, layout = problem.options, problem.layout
    sigma = estimate_pixel_sigma(problem, state) if pixel_sigma is None else pixel_sigma
    plain = replace(problem, options=replace(options, loss="squared", pixel_sigma=sigma))
    found = Covariance.of(plain.linearize(state).system)
    kept = found.reduced * sigma**2
    points = kept.new_zeros(layout.num_points, 3, 3)
    if layout.kept is not None:
        points[layout.free_points] = found.eliminated() * sigma**2
        columns = layout.point_columns(layout.kept_points)
        points[layout.kept_points] = kept[columns[:, :, None], columns[:, None, :]]
    elif not layout.hold_points:
        points = found.eliminated() * sigma**2
    poses = torch.arange(6 * layout.num_cameras, device=kept.device).view(-1, 6)
    deviation = torch.nn.functional.pad(kept.diagonal().clamp(min=0.0).sqrt(), (0, 1))
    lenses = torch.arange(layout.num_lenses, device=kept.device)
    return Uncertainty(
        pixel_sigma=sigma,
        pose=kept[poses[:, :, None], poses[:, None, :]],
        points=points,
        lens={name: deviation[layout.lens_columns(name, lenses)] for name in layout.lens},
        index_ratio=deviation[layout.index_column()],
        planes=deviation[layout.plane_columns(torch.arange(layout.num_planes, device=kept.device))],
        covariance=kept,
        layout=layout,
    )


def estimate_pixel_sigma(problem: BundleProblem, state: BundleState) -> float:
    """The effective standard deviation of a keypoint's coordinate, pixels, from the residuals at a minimum."""
    options = problem.options
    square = problem.squared_errors(state)
    _, weight = robust(square, options.loss, options.loss_scale)
    turned = 0.5 * (weight.square() * square).sum()
    taken = min(problem.unknowns_per_residual, 0.99)
    slopes = _slopes(weight, options.loss)
    mean = slopes.mean()
    fitted = 1.0 + taken * (slopes - mean).square().mean() / mean.square()  # K of Huber and Ronchetti, section 7.6
    variance = turned / (len(square) * (1.0 - taken)) * (fitted / mean).square()
    return float(variance.sqrt())


def _slopes(weight: Tensor, loss: LossName) -> Tensor:
    """Derivatives of the weighted residual w r along r and across (2, N): w + 2 w' s and w."""
    along = {"huber": torch.where(weight < 1.0, 0.0, weight), "cauchy": weight * (2.0 * weight - 1.0)}
    return torch.stack((along.get(loss, weight), weight))
