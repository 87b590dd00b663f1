"""Dense reconstruction through water: patches compared photometrically in several images (section 3.6 of the paper)."""

from torchrefrac.dense.densify import Dense, DenseError, densify, depth_maps
from torchrefrac.dense.options import DenseOptions, SweepOptions
from torchrefrac.dense.photometric import patch_costs
from torchrefrac.dense.store import FolderStore
from torchrefrac.dense.window import Window

__all__ = [
    "Dense", "DenseError", "DenseOptions", "FolderStore", "SweepOptions", "Window", "densify", "depth_maps",
    "patch_costs",
]  # fmt: skip
