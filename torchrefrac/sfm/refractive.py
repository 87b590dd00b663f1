"""Poses through the water with measured verticals (paper, section 3.4)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid, level_rotation
from torchrefrac.numerics import device_of, on_device
from torchrefrac.ransac import (
    AbsolutePoseEstimators,
    Estimators,
    RansacOptions,
    RansacReport,
    RelativePoseEstimators,
    ransac_each,
)
from torchrefrac.refinement import OneView, PoseData, TwoViews
from torchrefrac.scene import Capture
from torchrefrac.sfm.pose import PairPose, Pixels, Pose, Resection, judge_pair
from torchrefrac.sfm.rules import SfmOptions

THICK = 25.0
"""Times the layers before the water, of a first height that nobody states."""

D = TypeVar("D", bound=PoseData[Any])


@dataclass(frozen=True)
class RefractiveInitializer:
    """LO-MSAC over the solvers with known vertical; the optimisation in it has gravity as a prior.

    Layers between air and water add a number to the height of the camera that hardly depends on the ray: here it is
    that of rays along the normal, which is right to some hundredths of a pixel through glass a hand's breadth away.
    """

    capture: Capture
    index_ratio: float
    options: SfmOptions

    def relative(self, images: tuple[int, int], pixels: Pixels, generator: torch.Generator) -> PairPose | None:
        return self.relative_each([images], [pixels], [generator])[0]

    def relative_each(
        self, images: Sequence[tuple[int, int]], pixels: Sequence[Pixels], generators: Sequence[torch.Generator]
    ) -> list[PairPose | None]:
        if not images:
            return []
        least = max(self.options.min_pair_inliers, self.options.ransac.min_inliers)
        dry = [self._dry(*pair) for pair in zip(images, pixels, strict=True)]
        views = [self._views(*pair) for pair in zip(images, pixels, dry, strict=True)]
        options = replace(self.options.ransac, min_inliers=least)
        reports = self._reports(RelativePoseEstimators, views, options, generators)
        return [self._judged(*pair) for pair in zip(reports, views, images, pixels, dry, strict=True)]

    def _views(self, images: tuple[int, int], pixels: Pixels, dry: Bool[Tensor, " k"] | None) -> TwoViews:
        """What the pose of a pair is found by: the matches that look through the water."""
        views = TwoViews(
            *self.capture.planes(images, pixels),
            cam_from_level=level_rotation(self.capture.down_in_cam[list(images)]),
            focal=self.capture.intrinsics_of(list(images)).focal,
            index_ratio=self._ratio,
            gravity_sigma=float(self.capture.down_sigma[list(images)].max()),
            pixel_sigma=self.options.bundle.pixel_sigma,
        )
        return views if dry is None else views.rows(~dry)

    def _judged(
        self,
        report: RansacReport,
        views: TwoViews,
        images: tuple[int, int],
        pixels: Pixels,
        dry: Bool[Tensor, " k"] | None,
    ) -> PairPose | None:
        """The pose of a pair, and which of all matches agree with it."""
        if report.status == "degenerate":
            inliers = report.inliers if dry is None else (~dry).masked_scatter(~dry, report.inliers)
            return PairPose(None, None, inliers, 0.0)
        if report.status != "success":
            return None
        rotation, center = (part[0] for part in views.poses(report.model[None]))
        intrinsics, limit = self.capture.intrinsics_of(list(images)), self.options.ransac.max_error
        judged = judge_pair(Rigid(rotation, center), pixels, intrinsics, self._ratio, limit, dry)
        return (
            judged if judged.center is None else replace(judged, center=self._before_layers(judged.center, images[0]))
        )

    def absolute(self, image: Resection, generator: torch.Generator) -> Pose | None:
        return self.absolute_each([image], [generator])[0]

    def absolute_each(self, images: Sequence[Resection], generators: Sequence[torch.Generator]) -> list[Pose | None]:
        if not images:
            return []
        views = [self._view(*image) for image in images]
        reports = self._reports(AbsolutePoseEstimators, views, self.options.ransac, generators)
        return [self._pose(*found) for found in zip(reports, views, strict=True)]

    def _view(
        self, image: int, intrinsics: Intrinsics, pixels: Float[Tensor, "k 2"], points: Float[Tensor, "k 3"]
    ) -> OneView:
        return OneView(
            intrinsics.plane_from_pixels(pixels),
            points,
            cam_from_level=level_rotation(self.capture.down_in_cam[image]),
            focal=intrinsics.focal,
            index_ratio=self._ratio,
            gravity_sigma=float(self.capture.down_sigma[image]),
            pixel_sigma=self.options.bundle.pixel_sigma,
        )

    def _pose(self, report: RansacReport, view: OneView) -> Pose | None:
        if report.status != "success":
            return None
        rotation, center = (part[0] for part in view.poses(report.model[None]))
        return Pose(rotation, center - self._lift, report.inliers)

    def _reports(
        self,
        estimators: Callable[[Sequence[D]], Estimators],
        problems: Sequence[D],
        options: RansacOptions,
        generators: Sequence[torch.Generator],
    ) -> list[RansacReport]:
        """Of problems that are solved on the device of the options; where the problems are."""
        there = estimators(on_device(problems, device_of(self.options.device)))
        return on_device(ransac_each(there, options, generators), problems[0].focal.device)

    def _before_layers(self, center: Float[Tensor, "2 3"], first: int) -> Float[Tensor, "2 3"]:
        """Centres of a pair, of which that of image `first` is at height 1, in the unit of the layers, if there are
        any, and as high as they are before them."""
        if not self.capture.interfaces.has_layers:
            return center
        stated, layers = self.capture.height[first], self.capture.interfaces.thickness.sum(dim=-1).max()
        unit = torch.where(self.capture.has_height[first], stated, THICK * layers)
        return (unit + self._lift[2]) * center - self._lift

    @property
    def _lift(self) -> Float[Tensor, "3"]:
        """By how much higher cameras seem to stand before the layers, along the normal."""
        return self.capture.interfaces.lift()[0] * torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)

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
