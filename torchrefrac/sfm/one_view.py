"""Polish the pose of one image: adjust, judge its points anew, adjust again. That without refraction needs it."""

from torch import Tensor

from torchrefrac.bundle import BundleState, adjust_pose
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.pose import Pose

ROUNDS = 2
MIN_INLIERS = 3


def refine_pose(
    pose: Pose,
    pixels: Tensor,
    points: Tensor,
    intrinsics: Intrinsics,
    index_ratio: Tensor,
    options: SfmOptions,
) -> Pose:
    """Adjust one camera to its inliers, twice; inliers are then those within ransac.max_error."""
    for _ in range(ROUNDS):
        state = BundleState(pose.rotation[None], pose.center[None], points[pose.inliers], intrinsics, index_ratio)
        report = adjust_pose(state, pixels[pose.inliers], options.bundle)
        rotation, center = report.state.rotation[0], report.state.center[0]
        camera = RefractiveCamera(intrinsics, rotation, center, FlatInterface(index_ratio), check=False)
        projected, valid = camera.project(points)
        inliers = valid & ((projected - pixels).norm(dim=-1) < options.ransac.max_error)
        pose = Pose(rotation, center, inliers)
        if int(inliers.sum()) < MIN_INLIERS:
            break
    return pose
