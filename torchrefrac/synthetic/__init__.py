"""Scenes that are made rather than photographed: surfaces, cameras over water, and the photographs they would take."""

from torchrefrac.synthetic.library import made_scene
from torchrefrac.synthetic.options import (
    CameraOptions,
    InertialOptions,
    InterfaceOptions,
    SensorOptions,
    SyntheticOptions,
    WaveOptions,
)
from torchrefrac.synthetic.scenes import (
    AquariumOptions,
    CansOptions,
    HousingOptions,
    MeshOptions,
    RiverbedOptions,
    TableOptions,
    TankOptions,
)
from torchrefrac.synthetic.stage import StageError

__all__ = [
    "AquariumOptions", "CameraOptions", "CansOptions", "HousingOptions", "InertialOptions", "InterfaceOptions",
    "MeshOptions", "RiverbedOptions", "SensorOptions", "StageError", "SyntheticOptions", "TableOptions", "TankOptions",
    "WaveOptions", "made_scene",
]  # fmt: skip
