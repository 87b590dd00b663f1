"""Polish the pose of one view: adjust, judge its points again, adjust again. That without refraction needs it."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.bundle import BundleOptions, adjust_pose
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces, Observations, Scene, reprojection_errors
from torchrefrac.sfm.pose import Pose

ROUNDS = 2
MIN_INLIERS = 3


def refine_pose(
    pose: Pose,
    pixels: Float[Tensor, "k 2"],
    points: Float[Tensor, "k 3"],
    intrinsics: Intrinsics,
    options: BundleOptions,
    max_error: float,
) -> Pose:
    """Adjust one camera without refraction to its inliers, twice; inliers are then those within max_error."""
    for _ in range(ROUNDS):
        count = torch.arange(int(pose.inliers.sum()))
        seen = Observations(torch.zeros_like(count), count, pixels[pose.inliers])
        rigid, air = Rigid(pose.rotation[None], pose.center[None]), Interfaces.level(1.0)
        adjusted = adjust_pose(Scene.create(rigid, intrinsics, air, points[pose.inliers], seen), options).scene
        inliers = reprojection_errors(adjusted.camera_of(0), points, pixels) < max_error
        pose = Pose(adjusted.views.rotation[0], adjusted.views.center[0], inliers)
        if int(inliers.sum()) < MIN_INLIERS:
            break
    return pose
