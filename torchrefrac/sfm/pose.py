"""What an initialiser must be able to do: the pose of a pair, and of one more image."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


@dataclass(frozen=True)
class Pose:
    """cam_from_world rotation (3, 3), center in the world (3), and which data agree (N)."""

    rotation: Tensor
    center: Tensor
    inliers: Tensor


@dataclass(frozen=True)
class PairPose:
    """Two cameras in a frame of their own: rotation (2, 3, 3), center (2, 3); inliers (N), and the median angle
    (radians) between their rays. Without a pose where the inliers agree on one but do not determine it."""

    rotation: Tensor | None
    center: Tensor | None
    inliers: Tensor
    median_angle: float


class PoseInitializer(Protocol):
    """Finds poses without a starting value; None where the data do not carry one."""

    @property
    def index_ratio(self) -> Tensor:
        """Scalar float64; 1 where the initialiser knows no refraction."""
        ...

    def relative(
        self, images: tuple[int, int], pixels: tuple[Tensor, Tensor], generator: torch.Generator
    ) -> PairPose | None:
        """Pose of two images from matched pixels (N, 2) each."""
        ...

    def absolute(self, image: int, pixels: Tensor, points: Tensor, generator: torch.Generator) -> Pose | None:
        """Pose of an image that sees known points (N, 3) at pixels (N, 2)."""
        ...
