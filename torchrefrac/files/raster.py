"""Files of a raster: `dsm.npz`, and GeoTIFF for geographic information systems."""

from pathlib import Path

import numpy as np
import torch

from torchrefrac.atomic import replacing
from torchrefrac.files.npz import read_arrays, write_arrays
from torchrefrac.files.ply import DenseFileError
from torchrefrac.scene.raster import Raster

FORMAT = "torchrefrac-raster/1"
DSM = "dsm.npz"
GRIDS = {
    "height": "n:rc", "depth": "n:rc", "sigma": "n:rc", "count": "i:rc", "colors": "c:rc3", "valid": "b:rc",
    "filled": "b:rc",
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
    grids = (torch.from_numpy(found[name]) for name in GRIDS if name != "depth")
    west, north, size = (float(found[name]) for name in NUMBERS)
    return Raster(*grids, x_west=west, y_north=north, cell_size=size, length_unit=str(found["length_unit"]))


def require_geotiff(crs: str | None = None) -> None:
    """Raise what `write_geotiff` would: ImportError where rasterio is missing, ValueError where crs is not known."""
    try:
        import rasterio  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra
        from rasterio.errors import CRSError  # type: ignore[import-not-found]  # noqa: PLC0415
    except ImportError:
        raise ImportError("a GeoTIFF needs rasterio, which is not installed: pip install torchrefrac[geo]") from None
    try:
        if crs is not None:
            rasterio.CRS.from_user_input(crs)
    except CRSError as error:
        raise ValueError(f"crs is {crs!r}, which is no coordinate reference system: {error}") from None


def write_geotiff(raster: Raster, path: str | Path, crs: str | None = None) -> None:
    """Write height and depth as the two bands of a GeoTIFF, float32, NaN where there is no surface.

    crs: the coordinate reference system that the world frame's x and y are in, as "EPSG:32633"; without it the file
    has local coordinates. The tags of the file hold the unit of length. Needs rasterio, of the extra `geo`.

    Raises ImportError where rasterio is missing, ValueError where the raster has no cells or crs is not known.
    """
    require_geotiff(crs)
    import rasterio  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra

    rows, columns = raster.height.shape
    if not rows * columns:
        raise ValueError(f"the raster for {path} has no cells, but a GeoTIFF must have at least one")
    system = None if crs is None else rasterio.CRS.from_user_input(crs)
    bands = torch.stack((raster.height, raster.depth)).where(raster.valid, torch.nan).float().cpu().numpy()
    size = raster.cell_size
    with (
        replacing(Path(path)) as temporary,
        rasterio.open(
            temporary, "w", driver="GTiff", width=columns, height=rows, count=2, dtype="float32", nodata=np.nan,
            crs=system, transform=rasterio.Affine(size, 0.0, raster.x_west, 0.0, -size, raster.y_north),
            compress="deflate", predictor=3, tiled=True, blockxsize=256, blockysize=256, BIGTIFF="IF_SAFER",
        ) as file,
    ):  # fmt: skip
        file.write(bands)
        file.update_tags(length_unit=raster.length_unit)
        for band, name in enumerate(("height", "depth"), start=1):
            file.set_band_description(band, name)
            file.set_band_unit(band, raster.length_unit)
