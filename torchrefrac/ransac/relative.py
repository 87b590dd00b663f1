"""Relative pose of two cameras above water with measured verticals, by their refractive epipolar errors."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.minimal.four_point import unchecked_relative_pose_4pt
from torchrefrac.minimal.known_heading import unchecked_relative_pose_3pt
from torchrefrac.ransac.degeneracy import explain_relative
from torchrefrac.ransac.pose import PoseEstimator
from torchrefrac.ransac.rays import level_rays, require_data
from torchrefrac.refinement import TwoViews

QUICK, THOROUGH = ((2.0, 3), (1.0, 3)), ((1.0, 40),)


class RelativePoseEstimator(PoseEstimator[TwoViews]):
    """Models are those of `TwoViews`: tilts of both cameras (4), heading and centre of the second, relative to the
    first at (0, 0, height) with heading 0.

    Samples are solved with the measured verticals; the optimisation takes in their errors. The error of a match is the
    smallest correction of both pixels that makes their rays meet, to first order; they must meet below the water.
    """

    def __init__(self, views: TwoViews) -> None:
        require_data(views.plane1, plane2=views.plane2)
        require(
            views.index_ratio, "index_ratio (without refraction neither the scale nor the surface shows)", above=1.0
        )
        super().__init__(views, QUICK, THOROUGH)
        self.views = views
        self._rays1 = level_rays(views.plane1, views.cam_from_level[0])
        self._rays2 = level_rays(views.plane2, views.cam_from_level[1])

    @property
    def sample_size(self) -> int:
        return 4 if self.views.known_heading is None else 3

    def solve(self, samples: Int[Tensor, "s size"]) -> tuple[Float[Tensor, "s m 8"], Bool[Tensor, "s m"]]:
        rays1, rays2 = self._rays1[samples], self._rays2[samples]
        index, height = self.views.index_ratio, self.views.height
        if self.views.known_heading is None:
            heading, center, valid = unchecked_relative_pose_4pt(rays1, rays2, index, height)
        else:
            heading = rays1.new_full((len(samples), 1), self.views.known_heading)
            center, valid = unchecked_relative_pose_3pt(rays1, rays2, heading[:, 0], index, height)
            center, valid = center[:, None], valid[:, None]
        tilts = torch.zeros_like(heading)[..., None].expand(*heading.shape, 4)
        return torch.cat((tilts, heading[..., None], center), dim=-1), valid

    def degeneracy(self, model: Float[Tensor, " 8"], inliers: Bool[Tensor, " n"]) -> str:
        return explain_relative(self.views.rows(inliers), model)
