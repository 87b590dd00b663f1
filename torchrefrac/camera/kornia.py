"""To kornia's `PinholeCamera` and back. kornia is loaded when these functions are called.

kornia puts the centre of the top-left pixel at (0, 0), this package at (0.5, 0.5): the principal point is converted.
"""

from typing import TYPE_CHECKING

import torch

from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.camera.refractive import RefractiveCamera
from torchrefrac.checks import holds_everywhere
from torchrefrac.geometry import rotate
from torchrefrac.refraction import FlatInterface

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

HALF_PIXEL = 0.5


def from_kornia(pinhole: "PinholeCamera", interface: FlatInterface | None = None) -> RefractiveCamera:
    """A batch (B) of cameras with the pose and the intrinsics of `pinhole`, which look through `interface`.

    Without one nothing is refracted. Raises ValueError for images of different sizes in one batch, or skewed pixels.
    """
    width, height = int(pinhole.width[0]), int(pinhole.height[0])
    if not holds_everywhere((pinhole.width == width) & (pinhole.height == height)):
        raise ValueError("pinhole has images of different sizes, but one batch must have one size")
    matrix, rotation = pinhole.intrinsics, pinhole.extrinsics[..., :3, :3]
    if not holds_everywhere(matrix[..., 0, 1] == 0.0):
        raise ValueError("pinhole has skewed pixels, but the skew must be 0")
    intrinsics = Intrinsics(
        width,
        height,
        focal=torch.stack((matrix[..., 0, 0], matrix[..., 1, 1]), dim=-1),
        principal_point=matrix[..., :2, 2] + HALF_PIXEL,
        distortion=matrix.new_zeros(5),
    )
    center = -rotate(rotation.mT, pinhole.extrinsics[..., :3, 3])
    return RefractiveCamera(intrinsics, rotation, center, FlatInterface(1.0) if interface is None else interface)


def to_kornia(camera: RefractiveCamera) -> "PinholeCamera":
    """A pinhole of kornia with the pose and intrinsics of `camera`; its interface is left behind.

    The batch of any shape becomes one dimension (B), a single camera B = 1. Raises ValueError for distortion, which
    kornia's camera does not have.
    """
    from kornia.geometry.camera import PinholeCamera  # noqa: PLC0415 - importing it takes seconds

    intrinsics, batch = camera.intrinsics, camera.shape
    if not holds_everywhere(intrinsics.distortion == 0.0):
        raise ValueError("camera has lens distortion, but must have none: undistort its images first")
    rotation = camera.cam_from_world_rotation.expand(*batch, 3, 3).reshape(-1, 3, 3)
    center = camera.center_in_world.expand(*batch, 3).reshape(-1, 3)
    count = len(center)
    extrinsics = torch.eye(4, dtype=center.dtype, device=center.device).repeat(count, 1, 1)
    matrix = extrinsics.clone()
    extrinsics[:, :3, :3] = rotation
    extrinsics[:, :3, 3] = -rotate(rotation, center)
    focal = intrinsics.focal.expand(*batch, 2).reshape(-1, 2)
    matrix[:, 0, 0], matrix[:, 1, 1] = focal[:, 0], focal[:, 1]
    matrix[:, :2, 2] = intrinsics.principal_point.expand(*batch, 2).reshape(-1, 2) - HALF_PIXEL
    size = center.new_ones(count)
    return PinholeCamera(matrix, extrinsics, size * intrinsics.height, size * intrinsics.width)
