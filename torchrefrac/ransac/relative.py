"""Relative pose with known verticals, scored by refractive reprojection error."""

import torch
from torch import Tensor

from torchrefrac.geometry import heading_rotation
from torchrefrac.minimal import relative_pose_npt
from torchrefrac.minimal.rays import slopes
from torchrefrac.refraction import FlatInterface, lift_points


class RelativePoseEstimator:
    """Models are (heading, c_x, c_y, c_z) of the second camera; the first stands at (0, 0, height), heading 0.

    plane1, plane2 (N, 2): ideal image-plane coordinates of the matches; cam1_from_level, cam2_from_level (3, 3);
    focal (2): scales image-plane errors to pixels. The error of a match is the root mean square over both images
    of the reprojection error of its triangulated point, which must lie below the water and ahead of both cameras.
    """

    sample_size = 7

    def __init__(
        self,
        plane1: Tensor,
        plane2: Tensor,
        cam1_from_level: Tensor,
        cam2_from_level: Tensor,
        focal: Tensor,
        index_ratio: Tensor,
        height: float = 1.0,
    ) -> None:
        self.height = height
        self._plane1, self._plane2 = plane1, plane2
        self._cam1_from_level, self._cam2_from_level = cam1_from_level, cam2_from_level
        self._focal, self._index_ratio, self._interface = focal, index_ratio, FlatInterface(index_ratio)
        self._rays1 = level_rays(plane1, cam1_from_level)
        self._rays2 = level_rays(plane2, cam2_from_level)
        self._m1, self._g1 = slopes(self._rays1, index_ratio)
        self._m2, self._g2 = slopes(self._rays2, index_ratio)

    @property
    def num_data(self) -> int:
        return self._plane1.shape[0]

    def solve(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        return self._fit(self._rays1[samples], self._rays2[samples])

    def refit(self, model: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
        return self._fit(self._rays1[inliers], self._rays2[inliers])

    def squared_errors(self, models: Tensor) -> Tensor:
        points, possible = self.triangulate(models)
        first = points.new_tensor((0.0, 0.0, self.height))
        error1, ahead1 = self._error(points, first, self._cam1_from_level[None], self._plane1)
        cam2_from_world = self._cam2_from_level @ heading_rotation(models[:, 0])
        error2, ahead2 = self._error(points, models[:, None, 1:], cam2_from_world, self._plane2)
        possible = possible & ahead1 & ahead2
        return torch.where(possible, 0.5 * (error1 + error2), torch.inf)

    def triangulate(self, models: Tensor) -> tuple[Tensor, Tensor]:
        """Points (H, N, 3) where the rays in the water pass each other, and which lie below the surface (H, N).

        Both rays are linear in depth, p_xy = q + (m/g) p_z: p_z makes their horizontal distance smallest.
        """
        m1, g1, g2 = self._m1, self._g1, self._g2
        m2 = self._m2 @ heading_rotation(models[:, 0])[:, :2, :2]
        center = models[:, None, 1:]
        foot1 = -self.height * m1
        foot2 = center[..., :2] - center[..., 2:] * m2
        slope1, slope2 = m1 / g1[:, None], m2 / g2[:, None]
        gap, spread = foot1 - foot2, slope1 - slope2
        norm = spread.square().sum(dim=-1)
        tiny = torch.finfo(norm.dtype).tiny
        z = -(gap * spread).sum(dim=-1) / norm.clamp(min=tiny)
        below = (z < 0.0) & (norm > tiny)
        z = torch.where(below, z, -1.0)
        horizontal = 0.5 * (foot1 + foot2 + (slope1 + slope2) * z[..., None])
        return torch.cat((horizontal, z[..., None]), dim=-1), below

    def _fit(self, rays1: Tensor, rays2: Tensor) -> tuple[Tensor, Tensor]:
        heading, center, valid = relative_pose_npt(rays1, rays2, self._index_ratio, self.height)
        return torch.cat((heading[..., None], center), dim=-1), valid

    def _error(self, points: Tensor, center: Tensor, rotation: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
        return plane_error(points, center, rotation, plane, self._focal, self._interface)


def level_rays(plane: Tensor, cam_from_level: Tensor) -> Tensor:
    """Gravity-aligned rays (N, 3) of image-plane coordinates (N, 2)."""
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ cam_from_level


def plane_error(
    points: Tensor, center: Tensor, rotation: Tensor, plane: Tensor, focal: Tensor, interface: FlatInterface
) -> tuple[Tensor, Tensor]:
    """Squared reprojection error in pixels (H, N) of points (H, N, 3) or (N, 3), and which lie ahead.

    center broadcasts against the points, rotation (H, 3, 3). Measured before the lens: the distortion has been
    undone in `plane`, and a pixel there is a focal length's part.
    """
    center, points = torch.broadcast_tensors(center, points)
    offset, valid = lift_points(center, points, interface)
    x, y, z = (offset @ rotation.mT).unbind(dim=-1)
    ahead = valid & (z > 0.0)
    inverse = torch.where(ahead, z, 1.0).reciprocal()
    u = (x * inverse - plane[:, 0]) * focal[0]
    v = (y * inverse - plane[:, 1]) * focal[1]
    return u * u + v * v, ahead
