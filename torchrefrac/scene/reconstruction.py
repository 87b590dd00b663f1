"""A reconstruction: registered cameras and triangulated points."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface


@dataclass(frozen=True)
class Assessment:
    """How well a reconstruction is determined, as standard deviations; None: nothing can be said.

    pixel_sigma: of a keypoint's coordinate, pixels, as estimated from the residuals. point_sigma (n) and center_sigma
    (registered images): of a coordinate, in length_unit, relative to the cameras as a whole; center_covariance
    (registered images, 3, 3): of the centres in world axes, length_unit squared. index_ratio_sigma: None where it was
    given. determined: sentences about water, lens and scale; held: what was to be refined, but is not determined, and
    why.
    """

    pixel_sigma: float | None = None
    point_sigma: Tensor | None = None
    center_sigma: Tensor | None = None
    center_covariance: Tensor | None = None
    index_ratio_sigma: float | None = None
    determined: tuple[str, ...] = ()
    held: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Reconstruction:
    """m images, of which `registered` (m) have a pose; n points with their observations.

    rotation (m, 3, 3) cam_from_world and center (m, 3): identity and zero where not registered. points (n, 3) in
    length_unit, colors (n, 3) uint8. Observations (N), sorted by point: image, point, pixels (N, 2).
    failures: for each image that is not registered, why. World: z up, water surface at z = 0 (index_ratio > 1).
    """

    names: tuple[str, ...]
    registered: Tensor
    rotation: Tensor
    center: Tensor
    intrinsics: Intrinsics
    index_ratio: float
    length_unit: str
    points: Tensor
    colors: Tensor
    image: Tensor
    point: Tensor
    pixels: Tensor
    failures: dict[str, str] = field(default_factory=dict)
    assessment: Assessment = field(default_factory=Assessment)

    @property
    def interface(self) -> FlatInterface:
        return FlatInterface(self.index_ratio)

    @property
    def cameras(self) -> RefractiveCamera:
        """All images as one batch (m); entries that are not registered are meaningless."""
        return RefractiveCamera(self.intrinsics, self.rotation, self.center, self.interface, check=False)

    def reprojection_errors(self) -> Tensor:
        """Pixels (N): distance of each observation from its projected point; inf where that is impossible."""
        projected, valid = self.cameras[self.image].project(self.points[self.point])
        return torch.where(valid, (projected - self.pixels).norm(dim=-1), torch.inf)


def mean_deviation(covariance: Tensor) -> Tensor:
    """Standard deviation (*B) of a coordinate, the root of the mean variance along an axis, of (*B, 3, 3)."""
    return covariance.diagonal(dim1=-2, dim2=-1).mean(dim=-1).clamp(min=0.0).sqrt()
