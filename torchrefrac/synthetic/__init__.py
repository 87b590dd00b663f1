"""Scenes that are made rather than photographed: surfaces, cameras over water, and the photographs they would take."""

from torchrefrac.synthetic.library import made_scene
from torchrefrac.synthetic.options import CameraOptions, InertialOptions, SensorOptions, SyntheticOptions, WaveOptions
from torchrefrac.synthetic.scenes import CansOptions, MeshOptions, RiverbedOptions, TableOptions, TankOptions
from torchrefrac.synthetic.stage import StageError

__all__ = [
    "CameraOptions", "CansOptions", "InertialOptions", "MeshOptions", "RiverbedOptions", "SensorOptions", "StageError",
    "SyntheticOptions", "TableOptions", "TankOptions", "WaveOptions", "made_scene",
]  # fmt: skip
