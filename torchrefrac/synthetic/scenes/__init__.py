"""The scenes that can be made, by kind."""

from collections.abc import Callable
from typing import Any

from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.scenes.aquarium import AquariumOptions, aquarium_stage
from torchrefrac.synthetic.scenes.cans import CansOptions, cans_stage
from torchrefrac.synthetic.scenes.housing import HousingOptions, housing_stage
from torchrefrac.synthetic.scenes.mesh import MeshOptions, mesh_stage
from torchrefrac.synthetic.scenes.riverbed import RiverbedOptions, riverbed_stage
from torchrefrac.synthetic.scenes.table import TableOptions, table_stage
from torchrefrac.synthetic.scenes.tank import TankOptions, tank_stage
from torchrefrac.synthetic.stage import Stage

SCENES: dict[str, type[SyntheticOptions]] = {
    "tank": TankOptions, "cans": CansOptions, "riverbed": RiverbedOptions, "mesh": MeshOptions, "table": TableOptions,
    "aquarium": AquariumOptions, "housing": HousingOptions,
}  # fmt: skip
STAGES: dict[type[SyntheticOptions], Callable[[Any], Stage]] = {
    TankOptions: tank_stage, CansOptions: cans_stage, RiverbedOptions: riverbed_stage, MeshOptions: mesh_stage,
    TableOptions: table_stage, AquariumOptions: aquarium_stage, HousingOptions: housing_stage,
}  # fmt: skip


def stage_of(options: SyntheticOptions) -> Stage:
    """The scene that the options describe, ready to be photographed.

    Raises StageError where it cannot be made of what they name, and TypeError for options of no known scene.
    """
    for kind, stage in STAGES.items():
        if isinstance(options, kind):
            return stage(options)
    raise TypeError(f"options are {type(options).__name__}, but must be of one of {', '.join(SCENES)}")


__all__ = [
    "SCENES", "AquariumOptions", "CansOptions", "HousingOptions", "MeshOptions", "RiverbedOptions", "TableOptions",
    "TankOptions", "stage_of",
]  # fmt: skip
