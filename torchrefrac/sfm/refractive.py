"""Poses through the water with measured verticals (paper, section 3.4)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid, level_rotation
from torchrefrac.ransac import AbsolutePoseEstimator, RelativePoseEstimator, ransac
from torchrefrac.refinement import OneView, TwoViews
from torchrefrac.scene import Capture
from torchrefrac.sfm.pose import PairPose, Pixels, Pose, judge_pair
from torchrefrac.sfm.rules import SfmOptions


@dataclass(frozen=True)
class RefractiveInitializer:
    """LO-MSAC over the solvers with known vertical; the optimisation in it has gravity as a prior."""

    capture: Capture
    index_ratio: float
    options: SfmOptions

    def relative(self, images: tuple[int, int], pixels: Pixels, generator: torch.Generator) -> PairPose | None:
        intrinsics = self.capture.intrinsics_of(list(images))
        views = TwoViews(
            *self.capture.planes(images, pixels),
            cam_from_level=level_rotation(self.capture.down_in_cam[list(images)]),
            focal=intrinsics.focal,
            index_ratio=self._ratio,
            gravity_sigma=float(self.capture.down_sigma[list(images)].max()),
            pixel_sigma=self.options.bundle.pixel_sigma,
        )
        least = max(self.options.min_pair_inliers, self.options.ransac.min_inliers)
        dry = self._dry(images, pixels)
        views = views if dry is None else views.rows(~dry)
        report = ransac(RelativePoseEstimator(views), replace(self.options.ransac, min_inliers=least), generator)
        if report.status == "degenerate":
            inliers = report.inliers if dry is None else (~dry).masked_scatter(~dry, report.inliers)
            return PairPose(None, None, inliers, 0.0)
        if report.status != "success":
            return None
        rotation, center = (part[0] for part in views.poses(report.model[None]))
        return judge_pair(Rigid(rotation, center), pixels, intrinsics, self._ratio, self.options.ransac.max_error, dry)

    def absolute(
        self,
        image: int,
        intrinsics: Intrinsics,
        pixels: Float[Tensor, "k 2"],
        points: Float[Tensor, "k 3"],
        generator: torch.Generator,
    ) -> Pose | None:
        view = OneView(
            intrinsics.plane_from_pixels(pixels),
            points,
            cam_from_level=level_rotation(self.capture.down_in_cam[image]),
            focal=intrinsics.focal,
            index_ratio=self._ratio,
            gravity_sigma=float(self.capture.down_sigma[image]),
            pixel_sigma=self.options.bundle.pixel_sigma,
        )
        report = ransac(AbsolutePoseEstimator(view), self.options.ransac, generator)
        if report.status != "success":
            return None
        rotation, center = (part[0] for part in view.poses(report.model[None]))
        return Pose(rotation, center, report.inliers)

    def _dry(self, images: tuple[int, int], pixels: Pixels) -> Bool[Tensor, " k"] | None:
        """Which matches look past the water, where its extent is drawn; None where none do."""
        extent = self.capture.water_extent
        if extent is None or not extent.is_drawn:
            return None
        first, second = (extent.votes(image, at) for image, at in zip(images, pixels, strict=True))
        dry = first + second > 0
        return dry if bool(dry.any()) else None

    @property
    def _ratio(self) -> Float[Tensor, ""]:
        return torch.tensor(self.index_ratio, dtype=torch.float64)
