"""Reconstruction of scenes under water from photographs taken in air, with refraction at every stage.

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_HOME = {
    "Capture": "scene",
    "FlatInterface": "refraction",
    "Intrinsics": "camera",
    "Options": "config",
    "Reconstruction": "scene",
    "RefractiveCamera": "camera",
    "load_capture": "scene",
    "reconstruct": "pipeline",
    "solve_refrax": "refraction",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"torchrefrac.{_HOME[name]}"), name)
    if name in __all__:
        return import_module(f"torchrefrac.{name}")
    raise AttributeError(f"module 'torchrefrac' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
