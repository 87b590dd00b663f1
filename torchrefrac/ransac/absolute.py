"""Absolute pose of a camera above water with a measured vertical, by exact refractive reprojection errors."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.minimal.absolute_pose import unchecked_absolute_pose_2pt
from torchrefrac.minimal.known_heading import unchecked_absolute_pose_known_heading
from torchrefrac.ransac.degeneracy import explain_absolute
from torchrefrac.ransac.pose import PoseEstimator
from torchrefrac.ransac.rays import level_rays, require_data
from torchrefrac.refinement import OneView

QUICK, THOROUGH = ((4.0, 2), (1.0, 2)), ((1.0, 12),)


class AbsolutePoseEstimator(PoseEstimator[OneView]):
    """Models are those of `OneView`: tilt (2), heading and centre of a camera that sees known points, wet or dry.

    Samples are solved with the measured vertical; the optimisation takes in its error.
    """

    sample_size = 2

    def __init__(self, view: OneView) -> None:
        require_data(view.plane, points=view.points)
        super().__init__(view, QUICK, THOROUGH)
        self.view = view
        self._rays = level_rays(view.plane, view.cam_from_level)

    def solve(self, samples: Int[Tensor, "s 2"]) -> tuple[Float[Tensor, "s m 6"], Bool[Tensor, "s m"]]:
        rays, points, index = self._rays[samples], self.view.points[samples], self.view.index_ratio
        if self.view.known_heading is None:
            heading, center, valid = unchecked_absolute_pose_2pt(rays, points, index)
        else:
            heading = rays.new_full((len(samples), 1), self.view.known_heading)
            center, valid = unchecked_absolute_pose_known_heading(rays, points, heading[:, 0], index)
            center, valid = center[:, None], valid[:, None]
        tilt = torch.zeros_like(heading)[..., None].expand(*heading.shape, 2)
        return torch.cat((tilt, heading[..., None], center), dim=-1), valid

    def degeneracy(self, model: Float[Tensor, " 6"], inliers: Bool[Tensor, " n"]) -> str:
        return explain_absolute(self.view.rows(inliers), model)
