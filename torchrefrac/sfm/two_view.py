"""Polish the pose of a pair: adjust, judge the matches anew, adjust again. Those without refraction need it."""

from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.bundle import BundleOptions, BundleState, Observations, adjust
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.numerics import thin
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.refraction import FlatInterface
from torchrefrac.sfm.pose import PairPose
from torchrefrac.sfm.rays import triangulate_rays

ROUNDS = 2
MIN_INLIERS = 6
MAX_MATCHES = 400
SOLVER = LevenbergMarquardtOptions(max_iterations=8, function_tolerance=1e-3)


def refine_pair(
    rotation: Tensor,
    center: Tensor,
    pixels: tuple[Tensor, Tensor],
    inliers: Tensor,
    intrinsics: Intrinsics,
    index_ratio: Tensor,
    options: BundleOptions,
    max_error: float,
) -> PairPose:
    """Two-view bundle adjustment from a rough pose: rotation (2, 3, 3), center (2, 3), pixels (N, 2) twice.

    `inliers` (N) start it; afterwards a match is an inlier when its point reprojects within max_error in both images.
    The adjustment takes MAX_MATCHES of them, evenly: more do not change the verdict on the rest.
    """
    both = torch.stack(pixels, dim=1)
    options = replace(options, refine=(), solver=SOLVER)
    pose = PairPose(rotation, center, inliers, 0.0)
    for _ in range(ROUNDS):
        rows = thin(inliers.nonzero()[:, 0], MAX_MATCHES)
        camera = _cameras(intrinsics, rotation, center, index_ratio)
        points, _, _ = triangulate_rays(camera, both[rows], _both_seen(both[rows]))
        report = adjust(
            BundleState(rotation, center, points, intrinsics, index_ratio),
            Observations(
                camera=torch.arange(2).repeat(len(rows)),
                point=torch.arange(len(rows)).repeat_interleave(2),
                pixels=both[rows].flatten(0, 1),
            ),
            options,
            check=False,
        )
        rotation, center = report.state.rotation, report.state.center
        pose = judge_pair(rotation, center, pixels, intrinsics, index_ratio, max_error)
        inliers = pose.inliers
        if int(inliers.sum()) < MIN_INLIERS:
            break
    return pose


def judge_pair(
    rotation: Tensor,
    center: Tensor,
    pixels: tuple[Tensor, Tensor],
    intrinsics: Intrinsics,
    index_ratio: Tensor,
    max_error: float,
) -> PairPose:
    """Which matches, of points in the water or in air, reproject within max_error in both images of a pose."""
    both = torch.stack(pixels, dim=1)
    camera = _cameras(intrinsics, rotation, center, index_ratio)
    points, angle, valid = triangulate_rays(camera, both, _both_seen(both))
    projected, possible = camera.project(points[:, None])
    error = (projected - both).norm(dim=-1).amax(dim=-1)
    inliers = valid & possible.all(dim=-1) & (error < max_error)
    median = float(angle[inliers].median()) if bool(inliers.any()) else 0.0
    return PairPose(rotation, center, inliers, median)


def _both_seen(both: Tensor) -> Tensor:
    return torch.ones(both.shape[:2], dtype=torch.bool)


def _cameras(intrinsics: Intrinsics, rotation: Tensor, center: Tensor, index_ratio: Tensor) -> RefractiveCamera:
    return RefractiveCamera(intrinsics, rotation, center, FlatInterface(index_ratio), check=False)
