"""Closed-form derivatives of the refractive projection.

The apparent offset is (p_xy - c_xy, -H), so only H carries refraction: with M = d(pixel)/d(x_in_cam) @ R the
derivative in the point is M with its third column spread by the four partials of H. No approximation is made
(the paper holds the refrax ratio constant here).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.camera.distortion import distort_with_jacobians
from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.refraction import lift_with_partials

MIN_DEPTH = 1e-9


class ProjectionJacobians(NamedTuple):
    """Derivatives of pixels (*B, 2).

    rotation (*B, 2, 3): left perturbation, R <- exp([w]x) R, radians; center, point (*B, 2, 3): world frame;
    focal (*B, 2, 2), principal_point (*B, 2, 2), distortion (*B, 2, 5); index_ratio (*B, 2).
    """

    rotation: Tensor
    center: Tensor
    point: Tensor
    focal: Tensor
    principal_point: Tensor
    distortion: Tensor
    index_ratio: Tensor


def project_with_jacobians(
    intrinsics: Intrinsics, rotation: Tensor, center: Tensor, points: Tensor, index_ratio: Tensor
) -> tuple[Tensor, ProjectionJacobians, Tensor]:
    """Pixels (*B, 2), derivatives and validity (*B) of world points (*B, 3) seen by cameras of one batch shape.

    rotation (*B, 3, 3) cam_from_world, center (*B, 3), index_ratio (*B) or a scalar. Entries that are not valid
    hold finite values.
    """
    lift, valid = lift_with_partials(center, points, index_ratio)
    x_in_cam = (rotation @ lift.offset[..., None])[..., 0]
    ahead = x_in_cam[..., 2] > MIN_DEPTH
    inverse_depth = torch.where(ahead, x_in_cam[..., 2], 1.0).reciprocal()
    xy = x_in_cam[..., :2] * inverse_depth[..., None]
    distorted, by_xy, by_distortion = distort_with_jacobians(xy, intrinsics.distortion)
    pixels = distorted * intrinsics.focal + intrinsics.principal_point

    to_pixel = by_xy * (inverse_depth[..., None, None] * intrinsics.focal[..., :, None])
    last = -(to_pixel @ xy[..., None])
    by_x_in_cam = torch.cat((to_pixel, last), dim=-1)
    by_rotation = -torch.linalg.cross(by_x_in_cam, x_in_cam[..., None, :].expand_as(by_x_in_cam), dim=-1)

    in_world = by_x_in_cam @ rotation
    vertical = in_world[..., 2]
    horizontal = in_world[..., :2] - vertical[..., None] * lift.by_horizontal[..., None, :]
    by_point = torch.cat((horizontal, -(vertical * lift.by_point_z[..., None])[..., None]), dim=-1)
    by_center = torch.cat((-horizontal, -(vertical * lift.by_center_z[..., None])[..., None]), dim=-1)
    jacobians = ProjectionJacobians(
        rotation=by_rotation,
        center=by_center,
        point=by_point,
        focal=torch.diag_embed(distorted),
        principal_point=torch.eye(2, dtype=pixels.dtype, device=pixels.device).expand(*pixels.shape, 2),
        distortion=by_distortion * intrinsics.focal[..., :, None],
        index_ratio=-vertical * lift.by_index[..., None],
    )
    return pixels, jacobians, valid & ahead
