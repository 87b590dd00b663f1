"""The bundle adjustment cost (paper, Eq. 20): reprojection errors through the water, robust, and gravity as a prior."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchrefrac.bundle.gauge import gauge_directions
from torchrefrac.bundle.gravity import GravityPrior
from torchrefrac.camera import Intrinsics, RefractiveCamera, project_with_jacobians
from torchrefrac.geometry import so3_exp
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

    index_ratio: scalar tensor. loss_scale (pixels) of the Huber loss; pixel_sigma (pixels) weighs pixels against the
    gravity prior, if there is one. The plan decides what varies: no points in it, and they are constants; shared
    unknowns in it, and they are the first radial terms of the lens. free_gauge: keep steps clear of the gauge.
    """

    plan: SchurPlan
    pixels: Tensor
    index_ratio: Tensor
    loss_scale: float
    pixel_sigma: float
    gravity: GravityPrior | None
    free_gauge: bool

    @cached_property
    def interface(self) -> FlatInterface:
        return FlatInterface(self.index_ratio)

    @property
    def refractive(self) -> bool:
        return float(self.index_ratio) > 1.0

    def residuals(self, state: BundleState) -> tuple[Tensor, Tensor]:
        """Reprojection errors in pixels (N, 2), and which observations are possible (N)."""
        cameras = RefractiveCamera(state.intrinsics, state.rotation, state.center, self.interface, check=False)
        projected, valid = cameras[self.plan.camera].project(state.points[self.plan.point])
        return projected - self.pixels, valid

    def cost(self, state: BundleState) -> Tensor:
        residual, valid = self.residuals(state)
        rho, _ = huber(residual.square().sum(dim=-1), self.loss_scale)
        impossible, _ = huber(residual.new_tensor(IMPOSSIBLE_PX**2), self.loss_scale)
        total = 0.5 * torch.where(valid, rho, impossible).sum()
        if self.gravity is not None:
            total = total + self.gravity.cost(state.rotation, self.pixel_sigma)
        return total

    def linearize(self, state: BundleState) -> NormalEquations:
        plan = self.plan
        rotation, center = state.rotation[plan.camera], state.center[plan.camera]
        projected, by, valid = project_with_jacobians(
            state.intrinsics, rotation, center, state.points[plan.point], self.interface
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
        if self.gravity is not None:
            system = self.gravity.add_to(system, state.rotation, self.pixel_sigma)
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
