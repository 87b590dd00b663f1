"""Lens and refraction together: `RefractiveCamera`, of which the pinhole is the case of index ratio 1."""

from torchrefrac.camera.distortion import distort, distort_with_jacobians, undistort
from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.camera.jacobians import ProjectionJacobians, project_with_jacobians
from torchrefrac.camera.refractive import RefractiveCamera

__all__ = [
    "Intrinsics",
    "ProjectionJacobians",
    "RefractiveCamera",
    "distort",
    "distort_with_jacobians",
    "project_with_jacobians",
    "undistort",
]
