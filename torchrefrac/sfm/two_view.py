"""Polish the pose of a pair: adjust, judge the matches again, adjust again. Those without refraction need it."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.bundle import BundleOptions, adjust
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Rigid
from torchrefrac.numerics import thin
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Interfaces, Observations, Scene
from torchrefrac.sfm.pose import PairPose
from torchrefrac.sfm.rays import Rays

ROUNDS = 2
MIN_INLIERS = 6
MAX_MATCHES = 400
SOLVER = LevenbergMarquardtOptions(max_iterations=8, function_tolerance=1e-3)

Pixels = tuple[Float[Tensor, "k 2"], Float[Tensor, "k 2"]]


def refine_pair(
    pose: Rigid,
    pixels: Pixels,
    inliers: Bool[Tensor, " k"],
    intrinsics: Intrinsics,
    options: BundleOptions,
    max_error: float,
) -> PairPose:
    """Two-view bundle adjustment without refraction from the rough pose of two cameras.

    `inliers` start it; afterwards a match is an inlier when its point reprojects within max_error in both images.
    The adjustment takes MAX_MATCHES of them, evenly: more do not change the verdict on the rest.
    """
    both, air = torch.stack(pixels, dim=1), Interfaces.level(1.0)
    options = replace(options, refine=(), solver=SOLVER)
    found = PairPose(pose.rotation, pose.center, inliers, 0.0)
    for _ in range(ROUNDS):
        rows = thin(inliers.nonzero()[:, 0], MAX_MATCHES)
        points, _, _ = _meet(_cameras(intrinsics, pose, air.index_ratio[0]), both[rows])
        seen = Observations(
            view=torch.arange(2).repeat(len(rows)),
            point=torch.arange(len(rows)).repeat_interleave(2),
            pixels=both[rows].flatten(0, 1),
        )
        pose = adjust(Scene.create(pose, intrinsics, air, points, seen), options, check=False).scene.views.pose
        found = judge_pair(pose, pixels, intrinsics, air.index_ratio[0], max_error)
        inliers = found.inliers
        if int(inliers.sum()) < MIN_INLIERS:
            break
    return found


def judge_pair(
    pose: Rigid, pixels: Pixels, intrinsics: Intrinsics, index_ratio: Float[Tensor, ""], max_error: float
) -> PairPose:
    """Which matches, of points in the water or in air, reproject within max_error in both images of a pose."""
    both = torch.stack(pixels, dim=1)
    camera = _cameras(intrinsics, pose, index_ratio)
    points, angle, valid = _meet(camera, both)
    projected, possible = camera.project(points[:, None])
    error = (projected - both).norm(dim=-1).amax(dim=-1)
    inliers = valid & possible.all(dim=-1) & (error < max_error)
    median = float(angle[inliers].median()) if bool(inliers.any()) else 0.0
    return PairPose(pose.rotation, pose.center, inliers, median)


def _meet(
    camera: RefractiveCamera, both: Float[Tensor, "k 2 2"]
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, " k"], Bool[Tensor, " k"]]:
    return Rays.of(camera, both).meet(lambda points: points[..., 2])


def _cameras(intrinsics: Intrinsics, pose: Rigid, index_ratio: Float[Tensor, ""]) -> RefractiveCamera:
    return RefractiveCamera(intrinsics, pose.rotation, pose.center, FlatInterface(index_ratio), check=False)
