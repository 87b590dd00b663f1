"""Intrinsics and refraction together: `RefractiveCamera`, of which the pinhole is the case of index ratio 1."""

from torchrefrac.camera.distortion import distort, distort_with_jacobians, undistort
from torchrefrac.camera.images import remove_refraction
from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.camera.jacobians import (
    ProjectionJacobians,
    project_with_jacobians,
    projection_along,
    projection_parts,
)
from torchrefrac.camera.kornia import from_kornia, to_kornia
from torchrefrac.camera.learnable import LearnableCamera
from torchrefrac.camera.refractive import RefractiveCamera

__all__ = [
    "Intrinsics", "LearnableCamera", "ProjectionJacobians", "RefractiveCamera", "distort", "distort_with_jacobians",
    "from_kornia", "project_with_jacobians", "projection_along", "projection_parts", "remove_refraction", "to_kornia",
    "undistort",
]  # fmt: skip
