"""`dsm.npz`: a raster with all that is known of it."""

from pathlib import Path

import numpy as np
import torch

from torchrefrac.files.npz import read_arrays, write_arrays
from torchrefrac.files.ply import DenseFileError
from torchrefrac.scene.raster import Raster

FORMAT = "torchrefrac-raster/1"
DSM = "dsm.npz"
GRIDS = {
    "height": "n:rc", "depth": "n:rc", "sigma": "n:rc", "count": "i:rc", "views": "n:rc", "colors": "c:rc3",
    "valid": "b:rc", "filled": "b:rc",
}  # fmt: skip
NUMBERS = ("x_west", "y_north", "cell_size")


def write_raster(raster: Raster, folder: str | Path) -> None:
    """Write `folder`/dsm.npz: every array and number of the raster under its own name, and `depth` beside `height`."""
    arrays = {name: getattr(raster, name).detach().cpu().numpy() for name in GRIDS}
    arrays |= {name: np.array(getattr(raster, name)) for name in ("length_unit", *NUMBERS)}
    write_arrays({"format": np.array(FORMAT), **arrays}, Path(folder) / DSM)


def load_raster(path: str | Path) -> Raster:
    """Read what `write_raster` wrote, to the last bit. Raises DenseFileError where the file is missing or damaged."""
    wanted = GRIDS | {"length_unit": "U:"} | dict.fromkeys(NUMBERS, "n:")
    found = read_arrays(path, wanted, DenseFileError, FORMAT)
    grids = {name: torch.from_numpy(found[name]) for name in GRIDS if name != "depth"}
    west, north, size = (float(found[name]) for name in NUMBERS)
    return Raster(**grids, x_west=west, y_north=north, cell_size=size, length_unit=str(found["length_unit"]))
