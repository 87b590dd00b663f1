"""Poses without refraction, for the baselines: OpenCV's essential matrix and PnP."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import Rigid, level_rotation
from torchrefrac.scene import Capture
from torchrefrac.sfm.one_view import refine_pose
from torchrefrac.sfm.pose import PairPose, Pose
from torchrefrac.sfm.rules import SfmOptions
from torchrefrac.sfm.two_view import refine_pair

MIN_ESSENTIAL = 8
MIN_PNP = 6


@dataclass(frozen=True)
class PinholeInitializer:
    """Ordinary pinhole poses, as a reconstruction that ignores the water finds them. Gravity only levels the frame."""

    capture: Capture
    options: SfmOptions

    @property
    def index_ratio(self) -> float:
        return 1.0

    def relative(
        self,
        images: tuple[int, int],
        pixels: tuple[Float[Tensor, "k 2"], Float[Tensor, "k 2"]],
        generator: torch.Generator,
    ) -> PairPose | None:
        if len(pixels[0]) < MIN_ESSENTIAL:
            return None
        self._seed(generator)
        intrinsics = self.capture.intrinsics
        plane1, plane2 = (intrinsics.plane_from_pixels(p).numpy() for p in pixels)
        threshold = self.options.ransac.max_error / float(intrinsics.focal.mean())
        found: Any = cv2.findEssentialMat(
            plane1, plane2, np.eye(3), cv2.RANSAC, self.options.ransac.confidence, threshold
        )
        essential, mask = found
        if essential is None or essential.shape != (3, 3):
            return None
        _, relative, translation, mask = cv2.recoverPose(essential, plane1, plane2, np.eye(3), mask=mask)
        inliers = torch.from_numpy(mask[:, 0] > 0)
        if int(inliers.sum()) < MIN_ESSENTIAL:
            return None
        cam1_from_world = level_rotation(self.capture.down_in_cam[images[0]])
        relative = torch.from_numpy(relative)
        first = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        baseline = -(cam1_from_world.T @ relative.T @ torch.from_numpy(translation[:, 0]))
        return refine_pair(
            Rigid(torch.stack((cam1_from_world, relative @ cam1_from_world)), torch.stack((first, first + baseline))),
            pixels,
            inliers,
            intrinsics,
            self.options.bundle,
            self.options.ransac.max_error,
        )

    def absolute(
        self, image: int, pixels: Float[Tensor, "k 2"], points: Float[Tensor, "k 3"], generator: torch.Generator
    ) -> Pose | None:
        if len(pixels) < MIN_PNP:
            return None
        self._seed(generator)
        intrinsics = self.capture.intrinsics
        plane = intrinsics.plane_from_pixels(pixels).numpy()
        result: Any = cv2.solvePnPRansac(
            points.numpy(),
            plane,
            np.eye(3),
            None,
            iterationsCount=1000,
            reprojectionError=self.options.ransac.max_error / float(intrinsics.focal.mean()),
            confidence=self.options.ransac.confidence,
            flags=cv2.SOLVEPNP_SQPNP,
        )
        found, rotation_vector, translation, rows = result  # OpenCV's stubs do not know that the last may be None
        if not found or rows is None or len(rows) < MIN_PNP:
            return None
        rotation = torch.from_numpy(cv2.Rodrigues(rotation_vector)[0])
        center = -(rotation.T @ torch.from_numpy(translation[:, 0]))
        inliers = torch.zeros(len(pixels), dtype=torch.bool)
        inliers[torch.from_numpy(rows[:, 0]).long()] = True
        pose = Pose(rotation, center, inliers)
        return refine_pose(pose, pixels, points, intrinsics, self.options.bundle, self.options.ransac.max_error)

    @staticmethod
    def _seed(generator: torch.Generator) -> None:
        cv2.setRNGSeed(int(torch.randint(1 << 30, (), generator=generator)))
