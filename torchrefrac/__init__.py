"""Reconstruction of scenes under water from photographs taken in air, with refraction at every stage.

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrefrac import minimal
    from torchrefrac.camera import (
        Intrinsics,
        LearnableCamera,
        RefractiveCamera,
        from_kornia,
        remove_refraction,
        to_kornia,
    )
    from torchrefrac.commands.reconstruct import reconstruct
    from torchrefrac.config import Options
    from torchrefrac.dense import DenseOptions, densify, patch_costs
    from torchrefrac.files.capture import load_capture
    from torchrefrac.geometry import Plane
    from torchrefrac.refraction import FlatInterface, solve_refrax, water_index
    from torchrefrac.scene import Capture, DenseCloud, Scene

__version__ = "0.1.0"

__all__ = [
    "Capture",
    "DenseCloud",
    "DenseOptions",
    "FlatInterface",
    "Intrinsics",
    "LearnableCamera",
    "Options",
    "Plane",
    "Scene",
    "RefractiveCamera",
    "densify",
    "from_kornia",
    "load_capture",
    "minimal",
    "patch_costs",
    "reconstruct",
    "remove_refraction",
    "solve_refrax",
    "to_kornia",
    "water_index",
]

_HOME = {
    "Capture": "scene",
    "DenseCloud": "scene",
    "DenseOptions": "dense",
    "FlatInterface": "refraction",
    "Intrinsics": "camera",
    "LearnableCamera": "camera",
    "Options": "config",
    "Plane": "geometry",
    "Scene": "scene",
    "RefractiveCamera": "camera",
    "densify": "dense",
    "from_kornia": "camera",
    "load_capture": "files.capture",
    "patch_costs": "dense",
    "reconstruct": "commands.reconstruct",
    "remove_refraction": "camera",
    "solve_refrax": "refraction",
    "to_kornia": "camera",
    "water_index": "refraction",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"torchrefrac.{_HOME[name]}"), name)
    if name in __all__:
        return import_module(f"torchrefrac.{name}")
    raise AttributeError(f"module 'torchrefrac' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
