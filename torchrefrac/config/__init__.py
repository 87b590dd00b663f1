"""The typed options of the commands, and how they are built from plain mappings."""

from torchrefrac.config.build import OptionError, build
from torchrefrac.config.options import (
    FRESH_WATER,
    LEVEL,
    AdjustOptions,
    DenseOutputs,
    DensifyOptions,
    ModelOptions,
    Options,
    OutputOptions,
    PlaneOptions,
    RunOptions,
    WaterOptions,
)
from torchrefrac.config.scenes import FolderOptions, build_scene, scene_folder

__all__ = [
    "FRESH_WATER", "LEVEL", "AdjustOptions", "DenseOutputs", "DensifyOptions", "FolderOptions", "ModelOptions",
    "OptionError", "Options", "OutputOptions", "PlaneOptions", "RunOptions", "WaterOptions", "build", "build_scene",
    "scene_folder",
]  # fmt: skip
