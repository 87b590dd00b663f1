"""Adjust cameras and points together, or one camera alone."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchrefrac.bundle.gravity import GravityPrior
from torchrefrac.bundle.problem import RADIAL_TERMS, BundleProblem, BundleState
from torchrefrac.optim import LevenbergMarquardtOptions, MinimizeReport, SchurPlan, minimize

BundleReport = MinimizeReport[BundleState]


@dataclass(frozen=True)
class BundleOptions:
    """loss_scale: Huber, pixels. pixel_sigma: expected noise of a keypoint, pixels; weighs it against gravity.

    refine_radial: let k1 and k2 of the shared lens vary.
    """

    loss_scale: float = 0.25
    pixel_sigma: float = 0.3
    refine_radial: bool = False
    solver: LevenbergMarquardtOptions = field(default_factory=LevenbergMarquardtOptions)


def adjust(
    state: BundleState,
    camera: Tensor,
    point: Tensor,
    pixels: Tensor,
    index_ratio: Tensor,
    options: BundleOptions,
    gravity: GravityPrior | None = None,
    callback: Callable[[int, float], None] | None = None,
) -> BundleReport:
    """Minimise reprojection error over all cameras and points of `state`.

    camera, point (N): ids into the state, points ascending, a pair at most once; pixels (N, 2). The gauge is free: the
    result is as near to the start as the data allow (4 degrees of freedom, 7 at index ratio 1); scale and place are the
    caller's to fix.
    """
    num_shared = RADIAL_TERMS if options.refine_radial else 0
    plan = SchurPlan.create(camera, point, len(state.center), len(state.points), num_shared)
    return minimize(_problem(plan, pixels, index_ratio, options, gravity, True), state, options.solver, callback)


def adjust_pose(
    state: BundleState,
    pixels: Tensor,
    index_ratio: Tensor,
    options: BundleOptions,
    gravity: GravityPrior | None = None,
) -> BundleReport:
    """Minimise the reprojection error of one camera (m = 1) that sees all points of `state`, held fixed."""
    count = len(state.points)
    plan = SchurPlan.create(
        torch.zeros(count, dtype=torch.long, device=pixels.device),
        torch.arange(count, device=pixels.device),
        num_cameras=1,
        num_points=0,
    )
    return minimize(_problem(plan, pixels, index_ratio, options, gravity, False), state, options.solver)


def _problem(
    plan: SchurPlan,
    pixels: Tensor,
    index_ratio: Tensor,
    options: BundleOptions,
    gravity: GravityPrior | None,
    free_gauge: bool,
) -> BundleProblem:
    return BundleProblem(plan, pixels, index_ratio, options.loss_scale, options.pixel_sigma, gravity, free_gauge)
