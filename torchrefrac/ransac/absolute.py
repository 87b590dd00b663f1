"""Absolute pose with known vertical, scored by refractive reprojection error."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.geometry import heading_rotation
from torchrefrac.minimal import absolute_pose_2pt, absolute_pose_lsqi
from torchrefrac.ransac.relative import level_rays, plane_error

SAMPLE_SIZE = 2


@dataclass(frozen=True)
class AbsolutePoseEstimator:
    """Models are (heading, c_x, c_y, c_z) of a camera that sees known points.

    plane (N, 2): ideal image-plane coordinates; points (N, 3) in the world; cam_from_level (3, 3); focal (2)
    scales image-plane errors to pixels.
    """

    plane: Tensor
    points: Tensor
    cam_from_level: Tensor
    focal: Tensor
    index_ratio: Tensor
    sample_size: int = SAMPLE_SIZE

    def __post_init__(self) -> None:
        object.__setattr__(self, "_rays", level_rays(self.plane, self.cam_from_level))

    @property
    def num_data(self) -> int:
        return self.plane.shape[0]

    def solve(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        rays: Tensor = self._rays  # type: ignore[attr-defined]
        heading, center, valid = absolute_pose_2pt(rays[samples], self.points[samples], self.index_ratio)
        return torch.cat((heading[..., None], center), dim=-1), valid

    def refit(self, model: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted by the inverse distance to the camera, which turns metric errors into angles."""
        rays: Tensor = self._rays  # type: ignore[attr-defined]
        points = self.points[inliers]
        weights = (points - model[1:]).norm(dim=-1).clamp(min=torch.finfo(points.dtype).eps).reciprocal()
        heading, center, valid = absolute_pose_lsqi(rays[inliers], points, self.index_ratio, weights)
        return torch.cat((heading[None], center))[None], valid[None]

    def squared_errors(self, models: Tensor) -> Tensor:
        rotation = self.cam_from_level @ heading_rotation(models[:, 0])
        error, ahead = plane_error(
            self.points[None], models[:, None, 1:], rotation, self.plane, self.focal, self.index_ratio
        )
        return torch.where(ahead, error, torch.inf)
