"""The bundle adjustment cost (paper, Eq. 20): reprojection errors through the water, robust, and gravity as a prior."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.bundle.gauge import gauge_directions
from torchrefrac.camera import Intrinsics, RefractiveCamera, project_with_jacobians
from torchrefrac.geometry import skew, so3_exp
from torchrefrac.optim import NormalEquations, SchurPlan, Step, huber
from torchrefrac.refraction import FlatInterface

IMPOSSIBLE_PX = 1e3
RADIAL_TERMS = 2


@dataclass(frozen=True)
class BundleState:
    """rotation (m, 3, 3) cam_from_world, center (m, 3), points (n, 3), and the intrinsics that all images share."""

    rotation: Tensor
    center: Tensor
    points: Tensor
    intrinsics: Intrinsics


@dataclass(frozen=True)
class BundleProblem:
    """Observations `pixels` (N, 2) of point `plan.point` by camera `plan.camera`.

    index_ratio: scalar tensor. down_in_cam (m, 3) and down_sigma (radians) of the gravity prior, None: no prior.
    loss_scale (pixels) of the Huber loss; pixel_sigma (pixels) weighs pixels against the prior.
    refine_radial: k1 and k2 vary. fixed_points: the points are constants.
    """

    plan: SchurPlan
    pixels: Tensor
    index_ratio: Tensor
    loss_scale: float
    pixel_sigma: float
    down_in_cam: Tensor | None
    down_sigma: float
    refine_radial: bool
    free_gauge: bool

    @property
    def refractive(self) -> bool:
        return float(self.index_ratio) > 1.0

    def residuals(self, state: BundleState) -> tuple[Tensor, Tensor]:
        """Reprojection errors in pixels (N, 2), and which observations are possible (N)."""
        camera = RefractiveCamera(state.intrinsics, state.rotation, state.center, FlatInterface(self.index_ratio))[
            self.plan.camera
        ]
        projected, valid = camera.project(state.points[self.plan.point])
        return projected - self.pixels, valid

    def cost(self, state: BundleState) -> Tensor:
        residual, valid = self.residuals(state)
        rho, _ = huber(residual.square().sum(dim=-1), self.loss_scale)
        impossible, _ = huber(residual.new_tensor(IMPOSSIBLE_PX**2), self.loss_scale)
        total = torch.where(valid, rho, impossible).sum()
        if self.down_in_cam is not None:
            total = total + self._prior_weight * (-state.rotation[..., 2] - self.down_in_cam).square().sum()
        return 0.5 * total

    def linearize(self, state: BundleState) -> NormalEquations:
        plan = self.plan
        rotation, center = state.rotation[plan.camera], state.center[plan.camera]
        projected, by, valid = project_with_jacobians(
            state.intrinsics, rotation, center, state.points[plan.point], self.index_ratio
        )
        residual = projected - self.pixels
        _, weight = huber(residual.square().sum(dim=-1), self.loss_scale)
        system = plan.linearize(
            residual,
            torch.cat((by.rotation, by.center), dim=-1),
            by.point,
            by.distortion[..., : plan.num_shared],
            torch.where(valid, weight, 0.0),
        )
        if self.down_in_cam is not None:
            system = self._add_gravity(system, state.rotation)
        if self.free_gauge:
            gauge = gauge_directions(state.rotation, state.center, plan.num_shared, self.refractive)
            system = replace(system, null_space=gauge)
        return system

    def retract(self, state: BundleState, step: Step) -> BundleState:
        size = 6 * self.plan.num_cameras
        blocks = step.camera[:size].reshape(-1, 6)
        intrinsics = state.intrinsics
        if self.plan.num_shared:
            change = torch.nn.functional.pad(step.camera[size:], (0, 5 - self.plan.num_shared))
            intrinsics = replace(intrinsics, distortion=intrinsics.distortion + change)
        return BundleState(
            rotation=so3_exp(blocks[:, :3]) @ state.rotation,
            center=state.center + blocks[:, 3:],
            points=state.points + step.point if self.plan.num_points else state.points,
            intrinsics=intrinsics,
        )

    @property
    def _prior_weight(self) -> float:
        return (self.pixel_sigma / self.down_sigma) ** 2

    def _add_gravity(self, system: NormalEquations, rotation: Tensor) -> NormalEquations:
        """Residual (R (0, 0, -1) - down_in_cam) / sigma per camera; its derivative in w is -[R (0, 0, -1)]x."""
        m = self.plan.num_cameras
        predicted = -rotation[..., 2]
        jacobian = -skew(predicted)
        error = predicted - self.down_in_cam
        hessian, gradient = system.hessian.clone(), system.gradient.clone()
        cameras = torch.arange(m, device=hessian.device)
        grid = hessian[: 6 * m, : 6 * m].view(m, 6, m, 6)
        grid[cameras, :3, cameras, :3] += self._prior_weight * (jacobian.mT @ jacobian)
        gradient[: 6 * m].view(m, 6)[:, :3] += self._prior_weight * (jacobian.mT @ error[..., None])[..., 0]
        return replace(system, hessian=hessian, gradient=gradient)
