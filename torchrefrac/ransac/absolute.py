"""Absolute pose with known vertical, scored by refractive reprojection error."""

import torch
from torch import Tensor

from torchrefrac.geometry import heading_rotation
from torchrefrac.minimal import absolute_pose_2pt, absolute_pose_lsqi
from torchrefrac.ransac.relative import level_rays, plane_error
from torchrefrac.refraction import FlatInterface


class AbsolutePoseEstimator:
    """Models are (heading, c_x, c_y, c_z) of a camera that sees known points.

    plane (N, 2): ideal image-plane coordinates; points (N, 3) in the world; cam_from_level (3, 3); focal (2)
    scales image-plane errors to pixels.
    """

    sample_size = 2

    def __init__(
        self, plane: Tensor, points: Tensor, cam_from_level: Tensor, focal: Tensor, index_ratio: Tensor
    ) -> None:
        self._plane, self._points = plane, points
        self._cam_from_level, self._focal, self._index_ratio = cam_from_level, focal, index_ratio
        self._interface = FlatInterface(index_ratio)
        self._rays = level_rays(plane, cam_from_level)

    @property
    def num_data(self) -> int:
        return self._plane.shape[0]

    def solve(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        heading, center, valid = absolute_pose_2pt(self._rays[samples], self._points[samples], self._index_ratio)
        return torch.cat((heading[..., None], center), dim=-1), valid

    def refit(self, model: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted by the inverse distance to the camera, which turns metric errors into angles."""
        points = self._points[inliers]
        weights = (points - model[1:]).norm(dim=-1).clamp(min=torch.finfo(points.dtype).eps).reciprocal()
        heading, center, valid = absolute_pose_lsqi(self._rays[inliers], points, self._index_ratio, weights)
        return torch.cat((heading[None], center))[None], valid[None]

    def squared_errors(self, models: Tensor) -> Tensor:
        rotation = self._cam_from_level @ heading_rotation(models[:, 0])
        error, ahead = plane_error(
            self._points[None], models[:, None, 1:], rotation, self._plane, self._focal, self._interface
        )
        return torch.where(ahead, error, torch.inf)
