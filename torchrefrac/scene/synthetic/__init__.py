"""Scenes that are made rather than photographed: surfaces, cameras over water, and the photographs they would take."""

from torchrefrac.scene.synthetic.library import made_scene
from torchrefrac.scene.synthetic.options import (
    CameraOptions,
    InertialOptions,
    SensorOptions,
    SyntheticOptions,
    WaveOptions,
)
from torchrefrac.scene.synthetic.scenes import CansOptions, MeshOptions, RiverbedOptions, TankOptions
from torchrefrac.scene.synthetic.stage import SceneError

__all__ = [
    "CameraOptions",
    "CansOptions",
    "InertialOptions",
    "MeshOptions",
    "RiverbedOptions",
    "SceneError",
    "SensorOptions",
    "SyntheticOptions",
    "TankOptions",
    "WaveOptions",
    "made_scene",
]
