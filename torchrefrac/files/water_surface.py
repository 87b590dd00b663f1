"""Surfaces of water of other programs: GeoTIFF rasters of heights, and triangles between points (PLY, OBJ)."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrefrac.files.geotiff import require_geotiff
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.scene import GridWater, MeshWater, SceneError, WaterHeights

RASTERS, MESHES = (".tif", ".tiff"), (".ply", ".obj")


def read_water_surface(path: Path) -> tuple[WaterHeights, str | None]:
    """Heights of water over x and y, and the reference system of a raster that says it. Raises SceneError, with the
    file, for anything that cannot be right."""
    if not path.is_file():
        raise SceneError(f"{path} is not a file, but water.surface must be a GeoTIFF, or triangles as PLY or OBJ")
    ending = path.suffix.lower()
    if ending in RASTERS:
        return _raster(path)
    if ending in MESHES:
        return _mesh(path), None
    raise SceneError(f"water.surface is {path}, but its name must end in {', '.join((*RASTERS, *MESHES))}")


def _raster(path: Path) -> tuple[WaterHeights, str | None]:
    try:
        require_geotiff()
    except ImportError as error:
        raise SceneError(f"{path}: {error}") from None
    import rasterio  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra
    from rasterio.errors import RasterioError  # type: ignore[import-not-found]  # noqa: PLC0415

    try:
        with rasterio.open(path) as file:
            band: Any = file.read(1, masked=True)
            place, system = file.transform, file.crs
    except RasterioError as error:
        raise SceneError(f"{path} cannot be read as a raster: {' '.join(str(error).split())}") from None
    if place.b or place.d or place.a <= 0.0 or place.e >= 0.0:
        raise SceneError(f"{path} has rows that do not run from west to east and north to south; resample it north up")
    values = np.ma.getdata(band).astype(np.float64)
    known = torch.from_numpy(~np.ma.getmaskarray(band) & np.isfinite(values))
    if not bool(known.any()):
        raise SceneError(f"{path} has no cell with a height of the water")
    height = torch.from_numpy(values).where(known, 0.0)
    grid = GridWater(height, known, float(place.c), float(place.f), (float(place.a), float(-place.e)))
    return grid, system.to_wkt() if system else None


def _mesh(path: Path) -> WaterHeights:
    import trimesh  # noqa: PLC0415 - slow to import, needed only here

    try:
        mesh: Any = trimesh.load_mesh(path, process=False)
        vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except (ValueError, AttributeError, IndexError, KeyError) as error:
        raise SceneError(f"{path} cannot be read as a mesh: {' '.join(str(error).split())}") from None
    if not len(faces) or not np.isfinite(vertices).all():
        raise SceneError(f"{path} has no triangles between points of finite coordinates; triangulate the water")
    return MeshWater(TriangleMesh(torch.from_numpy(vertices), torch.from_numpy(faces)))
