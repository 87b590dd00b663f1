"""Measured gravity as a soft prior on the rotation of every camera."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.geometry import skew
from torchrefrac.optim import NormalEquations


@dataclass(frozen=True)
class GravityPrior:
    """Unit directions down_in_cam (m, 3), each with an expected error of `sigma` radians.

    Cost: half of weight * |R (0, 0, -1) - down_in_cam|^2 per camera, where `weight` is (pixel sigma / sigma)^2, in
    squared pixels. It does not touch the gauge: shifts, heading and scale leave it as it is.
    """

    down_in_cam: Tensor
    sigma: float

    def cost(self, rotation: Tensor, pixel_sigma: float) -> Tensor:
        """Scalar, for rotations (m, 3, 3) cam_from_world."""
        return 0.5 * self._weight(pixel_sigma) * (self._predict(rotation) - self.down_in_cam).square().sum()

    def add_to(self, system: NormalEquations, rotation: Tensor, pixel_sigma: float) -> NormalEquations:
        """The normal equations with the prior in them; the derivative of R (0, 0, -1) in w is -[R (0, 0, -1)]x."""
        m, weight = len(rotation), self._weight(pixel_sigma)
        predicted = self._predict(rotation)
        jacobian = -skew(predicted)
        error = predicted - self.down_in_cam
        hessian, gradient = system.hessian.clone(), system.gradient.clone()
        cameras = torch.arange(m, device=hessian.device)
        grid = hessian[: 6 * m, : 6 * m].view(m, 6, m, 6)
        grid[cameras, :3, cameras, :3] += weight * (jacobian.mT @ jacobian)
        gradient[: 6 * m].view(m, 6)[:, :3] += weight * (jacobian.mT @ error[..., None])[..., 0]
        return replace(system, hessian=hessian, gradient=gradient)

    @staticmethod
    def _predict(rotation: Tensor) -> Tensor:
        return -rotation[..., 2]

    def _weight(self, pixel_sigma: float) -> float:
        return (pixel_sigma / self.sigma) ** 2
