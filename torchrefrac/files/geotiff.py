"""Cloud-optimised GeoTIFF: rasters for geographic information systems. Needs rasterio, of the extra `geo`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchrefrac.atomic import passing, replacing
from torchrefrac.scene.raster import Raster

MISSING = "a GeoTIFF needs rasterio, which is not installed: pip install torchrefrac[geo]"
TILE = 512
PLAIN: dict[str, Any] = {"tiled": True, "blockxsize": TILE, "blockysize": TILE, "BIGTIFF": "IF_SAFER"}
"""Of the file that is written first; the one that stays is a compressed copy with overviews."""


def require_geotiff(crs: str | None = None) -> None:
    """Raise what writing would: ImportError where rasterio is missing, ValueError where crs is not known."""
    try:
        import rasterio  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra
        from rasterio.errors import CRSError  # type: ignore[import-not-found]  # noqa: PLC0415
    except ImportError:
        raise ImportError(MISSING) from None
    try:
        if crs is not None:
            rasterio.CRS.from_user_input(crs)
    except CRSError as error:
        raise ValueError(f"crs is {crs!r}, which is no coordinate reference system: {error}") from None


def write_bands(
    bands: Mapping[str, Float[Tensor, "rows columns"]],
    path: str | Path,
    raster: Raster,
    unit: str = "",
    crs: str | None = None,
) -> None:
    """Write numbers of the cells of a raster as the bands of a GeoTIFF, float32, NaN where there is no surface.

    bands: by name, of the raster's own shape. unit: of all of them, such as "m". crs: the coordinate reference system
    that the raster's x and y are in, as "EPSG:32633"; without it the file has local coordinates. Its tags hold the unit
    of length. Raises ImportError where rasterio is missing, ValueError where the raster has no cells or crs is unknown.
    """
    values = torch.stack(tuple(bands.values())).where(raster.valid, torch.nan).float().cpu().numpy()
    options = {"dtype": "float32", "nodata": np.nan}
    _write(values, tuple(bands), path, raster, crs, options, {"predictor": "3"}, unit)


def write_image(
    colors: UInt8[Tensor, "rows columns 3"], path: str | Path, raster: Raster, crs: str | None = None
) -> None:
    """Write colours of the cells of a raster as red, green, blue and alpha, which is 0 where there is no surface; else
    as `write_bands`."""
    alpha = 255 * raster.valid.to(torch.uint8)[..., None]
    values = torch.cat((colors, alpha), dim=-1).permute(2, 0, 1).cpu().numpy()
    options = {"dtype": "uint8", "photometric": "RGB", "alpha": "YES"}
    _write(values, ("red", "green", "blue", "alpha"), path, raster, crs, options, {"predictor": "2"})


def _write(
    values: np.ndarray,
    names: tuple[str, ...],
    path: str | Path,
    raster: Raster,
    crs: str | None,
    options: Mapping[str, Any],
    compression: Mapping[str, str],
    unit: str = "",
) -> None:
    require_geotiff(crs)
    import rasterio  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra
    from rasterio.shutil import copy  # type: ignore[import-not-found]  # noqa: PLC0415

    count, rows, columns = values.shape
    if not rows * columns:
        raise ValueError(f"the raster for {path} has no cells, but a GeoTIFF must have at least one")
    system = None if crs is None else rasterio.CRS.from_user_input(crs)
    place = rasterio.Affine(raster.cell_size, 0.0, raster.x_west, 0.0, -raster.cell_size, raster.y_north)
    shape = {"width": columns, "height": rows, "count": count, "crs": system, "transform": place}
    path = Path(path)
    with replacing(path) as final, passing(final.with_suffix(".plain.tif")) as plain:
        with rasterio.open(plain, "w", driver="GTiff", **shape, **options, **PLAIN) as file:
            file.write(values)
            file.update_tags(length_unit=raster.length_unit)
            for band, name in enumerate(names, start=1):
                file.set_band_description(band, name)
                if unit:
                    file.set_band_unit(band, unit)
        copy(
            plain, final, driver="COG", COMPRESS="DEFLATE", PREDICTOR=compression["predictor"], BLOCKSIZE=str(TILE),
            BIGTIFF="IF_SAFER", OVERVIEWS="AUTO", RESAMPLING="AVERAGE",
        )  # fmt: skip
