"""The scenes that can be made, by kind."""

from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.scenes.cans import CansOptions, cans_stage
from torchrefrac.synthetic.scenes.mesh import MeshOptions, mesh_stage
from torchrefrac.synthetic.scenes.riverbed import RiverbedOptions, riverbed_stage
from torchrefrac.synthetic.scenes.tank import TankOptions, tank_stage
from torchrefrac.synthetic.stage import Stage

SCENES: dict[str, type[SyntheticOptions]] = {
    "tank": TankOptions, "cans": CansOptions, "riverbed": RiverbedOptions, "mesh": MeshOptions,
}  # fmt: skip


def stage_of(options: SyntheticOptions) -> Stage:
    """The scene that the options describe, ready to be photographed.

    Raises StageError where it cannot be made of what they name, and TypeError for options of no known scene.
    """
    match options:
        case TankOptions():
            return tank_stage(options)
        case CansOptions():
            return cans_stage(options)
        case RiverbedOptions():
            return riverbed_stage(options)
        case MeshOptions():
            return mesh_stage(options)
        case _:
            raise TypeError(f"options are {type(options).__name__}, but must be of one of {', '.join(SCENES)}")


__all__ = ["SCENES", "CansOptions", "MeshOptions", "RiverbedOptions", "TankOptions", "stage_of"]
