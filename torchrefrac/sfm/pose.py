"""What an initialiser must be able to do: the pose of a pair, and of one more view."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Pose:
    """cam_from_world, and which data agree."""

    rotation: Float[Tensor, "3 3"]
    center: Float[Tensor, "3"]
    inliers: Bool[Tensor, " k"]


@dataclass(frozen=True, eq=False)
class PairPose:
    """Two cameras in a frame of their own, which matches agree, and the median angle (radians) between their rays.
    Without a pose where the inliers agree on one but do not determine it."""

    rotation: Float[Tensor, "2 3 3"] | None
    center: Float[Tensor, "2 3"] | None
    inliers: Bool[Tensor, " k"]
    median_angle: float


class PoseInitializer(Protocol):
    """Finds poses without a starting value; None where the data do not carry one."""

    @property
    def index_ratio(self) -> float:
        """n_water / n_air; 1 where the initialiser knows no refraction."""
        ...

    def relative(
        self,
        images: tuple[int, int],
        pixels: tuple[Float[Tensor, "k 2"], Float[Tensor, "k 2"]],
        generator: torch.Generator,
    ) -> PairPose | None:
        """Pose of two images from matched pixels."""
        ...

    def absolute(
        self, image: int, pixels: Float[Tensor, "k 2"], points: Float[Tensor, "k 3"], generator: torch.Generator
    ) -> Pose | None:
        """Pose of an image that sees known points at these pixels."""
        ...
