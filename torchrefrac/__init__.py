"""Reconstruction of scenes under water from photographs taken in air, with refraction at every stage.

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrefrac import bundle, minimal, ransac, refinement, sfm
    from torchrefrac.bundle import BundleBatch, BundleOptions, adjust_differentiably, adjust_each
    from torchrefrac.camera import (
        Intrinsics,
        LearnableCamera,
        RefractiveCamera,
        from_kornia,
        remove_refraction,
        to_kornia,
    )
    from torchrefrac.commands.adjust import adjust
    from torchrefrac.commands.import_photographs import import_photographs
    from torchrefrac.commands.reconstruct import reconstruct
    from torchrefrac.config import Options
    from torchrefrac.config.importing import ImportOptions
    from torchrefrac.dense import DenseOptions, densify, patch_costs
    from torchrefrac.errors import TorchrefracError
    from torchrefrac.evaluate.metrics import evaluate
    from torchrefrac.files.cameras import load_cameras
    from torchrefrac.files.capture import load_capture
    from torchrefrac.files.library import embedded_scene
    from torchrefrac.files.survey import read_survey
    from torchrefrac.files.tracks import read_scene
    from torchrefrac.files.truth import load_truth
    from torchrefrac.files.work import Work
    from torchrefrac.geometry import Plane, Rigid
    from torchrefrac.learning import Rays, RefractiveRays
    from torchrefrac.parallel import ExecutorOptions, Workers
    from torchrefrac.refraction import FlatInterface, solve_refrax, water_index
    from torchrefrac.scene import Cameras, Capture, DenseCloud, Interfaces, Observations, Scene, Survey, Truth, Views
    from torchrefrac.sfm import ReadjustOptions, SfmOptions, triangulate_tracks
    from torchrefrac.synthetic import made_scene

__version__ = "0.1.0"

_HOME = {
    "bundle": ("BundleBatch", "BundleOptions", "adjust_differentiably", "adjust_each"),
    "camera": ("Intrinsics", "LearnableCamera", "RefractiveCamera", "from_kornia", "remove_refraction", "to_kornia"),
    "commands.adjust": ("adjust",),
    "commands.import_photographs": ("import_photographs",),
    "commands.reconstruct": ("reconstruct",),
    "config": ("Options",),
    "config.importing": ("ImportOptions",),
    "dense": ("DenseOptions", "densify", "patch_costs"),
    "errors": ("TorchrefracError",),
    "evaluate.metrics": ("evaluate",),
    "files.cameras": ("load_cameras",),
    "files.capture": ("load_capture",),
    "files.library": ("embedded_scene",),
    "files.survey": ("read_survey",),
    "files.tracks": ("read_scene",),
    "files.truth": ("load_truth",),
    "files.work": ("Work",),
    "geometry": ("Plane", "Rigid"),
    "learning": ("Rays", "RefractiveRays"),
    "parallel": ("ExecutorOptions", "Workers"),
    "refraction": ("FlatInterface", "solve_refrax", "water_index"),
    "scene": (
        "Cameras", "Capture", "DenseCloud", "Interfaces", "Observations", "Scene", "Survey", "Truth", "Views",
    ),
    "sfm": ("ReadjustOptions", "SfmOptions", "triangulate_tracks"),
    "synthetic": ("made_scene",),
}  # fmt: skip
_MODULES = ("bundle", "minimal", "ransac", "refinement", "sfm")
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "BundleBatch", "BundleOptions", "Cameras", "Capture", "DenseCloud", "DenseOptions", "ExecutorOptions",
    "FlatInterface", "ImportOptions", "Interfaces", "Intrinsics", "LearnableCamera", "Observations", "Options",
    "Plane", "Rays", "ReadjustOptions", "RefractiveCamera", "RefractiveRays", "Rigid", "Scene", "SfmOptions", "Survey",
    "TorchrefracError", "Truth", "Views", "Work", "Workers", "adjust", "adjust_differentiably", "adjust_each",
    "bundle", "densify", "embedded_scene", "evaluate", "from_kornia", "import_photographs", "load_cameras",
    "load_capture", "load_truth", "made_scene", "minimal", "patch_costs", "ransac", "read_scene", "read_survey",
    "reconstruct", "refinement", "remove_refraction", "sfm", "solve_refrax", "to_kornia", "triangulate_tracks",
    "water_index",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"torchrefrac.{_MODULE_OF[name]}"), name)
    if name in _MODULES:
        return import_module(f"torchrefrac.{name}")
    raise AttributeError(f"module 'torchrefrac' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


class _Package(ModuleType):
    """The package, in which `evaluate` is the function, also when the room of that name has been imported: Python would
    put the room in its place."""

    @property
    def evaluate(self) -> Any:
        return import_module("torchrefrac.evaluate.metrics").evaluate

    @evaluate.setter
    def evaluate(self, room: ModuleType) -> None:
        pass


sys.modules[__name__].__class__ = _Package
