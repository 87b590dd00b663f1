"""Reconstruction of scenes under water from photographs taken in air, with refraction at every stage."""

from torchrefrac import minimal
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.config import Options
from torchrefrac.pipeline import reconstruct
from torchrefrac.refraction import FlatInterface, solve_refrax
from torchrefrac.scene import Capture, Reconstruction, load_capture

__version__ = "0.1.0"

__all__ = [
    "Capture",
    "FlatInterface",
    "Intrinsics",
    "Options",
    "Reconstruction",
    "RefractiveCamera",
    "load_capture",
    "minimal",
    "reconstruct",
    "solve_refrax",
]
