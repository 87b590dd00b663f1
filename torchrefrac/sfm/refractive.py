"""Poses through the water with known verticals (paper, section 3.4)."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.bundle import GravityPrior
from torchrefrac.geometry import heading_rotation, level_rotation
from torchrefrac.ransac import AbsolutePoseEstimator, RansacOptions, RelativePoseEstimator, ransac
from torchrefrac.scene import Capture
from torchrefrac.sfm.one_view import refine_pose
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.pose import PairPose, Pose
from torchrefrac.sfm.two_view import refine_pair


@dataclass(frozen=True)
class RefractiveInitializer:
    """RANSAC over the known-vertical solvers with gravity taken for exact, then refinement with gravity as a prior."""

    capture: Capture
    index_ratio: Tensor
    options: SfmOptions

    def relative(
        self, images: tuple[int, int], pixels: tuple[Tensor, Tensor], generator: torch.Generator
    ) -> PairPose | None:
        intrinsics = self.capture.intrinsics
        down = self.capture.down_in_cam[list(images)]
        cam_from_level = level_rotation(down)
        plane1, plane2 = (intrinsics.plane_from_pixels(p) for p in pixels)
        estimator = RelativePoseEstimator(
            plane1, plane2, cam_from_level[0], cam_from_level[1], intrinsics.focal, self.index_ratio
        )
        report = ransac(estimator, self._loose(), generator)
        if report.status != "success":
            return None
        heading = torch.stack((torch.zeros_like(report.model[0]), report.model[0]))
        first = report.model.new_tensor((0.0, 0.0, estimator.height))
        return refine_pair(
            cam_from_level @ heading_rotation(heading),
            torch.stack((first, report.model[1:])),
            pixels,
            report.inliers,
            intrinsics,
            self.index_ratio,
            self.options.bundle,
            self.options.ransac.max_error,
            GravityPrior(down, self.capture.down_sigma),
        )

    def absolute(self, image: int, pixels: Tensor, points: Tensor, generator: torch.Generator) -> Pose | None:
        intrinsics = self.capture.intrinsics
        down = self.capture.down_in_cam[image]
        cam_from_level = level_rotation(down)
        plane = intrinsics.plane_from_pixels(pixels)
        estimator = AbsolutePoseEstimator(plane, points, cam_from_level, intrinsics.focal, self.index_ratio)
        report = ransac(estimator, self._loose(), generator)
        if report.status != "success":
            return None
        rotation = cam_from_level @ heading_rotation(report.model[0])
        return refine_pose(
            Pose(rotation, report.model[1:], report.inliers),
            pixels,
            points,
            intrinsics,
            self.index_ratio,
            self.options,
            GravityPrior(down[None], self.capture.down_sigma),
        )

    def _loose(self) -> RansacOptions:
        """A threshold that an exact pose with gravity off by two sigma still meets."""
        blur = float(self.capture.intrinsics.focal.mean()) * self.capture.down_sigma * 2.0
        return replace(self.options.ransac, max_error=self.options.ransac.max_error + blur)
