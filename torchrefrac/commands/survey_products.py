"""What surveyors take from a run: clouds and rasters on the map, with heights in the datum and their uncertainty."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.config import DenseOutputs, OptionError
from torchrefrac.dense.images import Images, photographs
from torchrefrac.dense.orthophoto import orthophoto
from torchrefrac.dense.rasterize import SAMPLE, Points, grid_of, in_chunks, raster_in_grid
from torchrefrac.dense.relief import hillshade
from torchrefrac.dense.tiles import Tile, count_tiles, raster_tiles
from torchrefrac.evaluate.survey_orders import BedStatistics, vertical_uncertainty
from torchrefrac.files.contours import write_contours
from torchrefrac.files.geotiff import BandFile, Place, band_file, color_file, require_geotiff
from torchrefrac.files.las import Extra, LasPoints, PointClass, extent_of, write_las
from torchrefrac.files.metadata.local_frame import Grid
from torchrefrac.files.run import CONTOURS, DENSE_LAZ, POINTS_LAZ, RASTERS
from torchrefrac.files.systems import system_of
from torchrefrac.geometry import Similarity
from torchrefrac.numerics import thin
from torchrefrac.recorder import Recorder
from torchrefrac.scene import DenseCloud, Georeference, Interfaces, Raster, RasterGrid, Scene
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.sfm.frame import moved

UNPLACED = Georeference("", (0.0, 0.0, 0.0))
"""Of a scene of which nobody knows where it stands: the numbers in files are those of its own frame."""


def require_place(outputs: DenseOutputs, place: Georeference | None) -> None:
    """Raise OptionError where a reference system is wanted that the scene is not placed in: it would be stamped on
    coordinates of another frame; or where files of a survey are wanted in a system that is not known, or has no axes in
    metres."""
    if outputs.for_surveys and place is not None:
        try:
            Grid(place.crs)
            require_geotiff(place.name)
        except ValueError as error:
            raise OptionError(f"georeference: {error}") from None
    if outputs.crs is None or (place is not None and _same(outputs.crs, place)):
        return
    if place is None:
        raise OptionError(
            f"outputs.crs is {outputs.crs!r}, but the capture does not say where its frame stands: import photographs "
            "with positions, or give a georeference in capture.json; without outputs.crs files are in its own frame"
        )
    raise OptionError(
        f"outputs.crs is {outputs.crs!r}, but the positions of the capture are in {place.name}; import the photographs "
        f"with crs={outputs.crs}"
    )


def require_surface(interfaces: Interfaces) -> None:
    """Raise OptionError where nothing is below a surface of water: depths, heights and orders of a survey mean nothing
    there."""
    through = next((kind for kind in interfaces.kinds if kind != SURFACE), None)
    if through is not None:
        raise OptionError(
            f"products of a survey are maps of a bed below a surface of water, but these photographs look through a "
            f"{through}; take dense.ply, mesh.ply and dsm.npz, which a dense stage writes without outputs=survey"
        )


def _same(crs: str, place: Georeference) -> bool:
    return system_of(crs) in (system_of(place.crs), system_of(place.name))


def write_survey_products(
    points: Points, scene: Scene, outputs: DenseOutputs, folder: Path, recorder: Recorder
) -> dict[str, Any]:
    """Write what `outputs` asks for of clouds and rasters on the map, each whole or not at all; metrics of the bed.

    points: a dense cloud, or a file of one; contours and the orthophoto take it into memory. Coordinates are those of
    the scene's georeference, in float64, heights those of its datum; where it has none, those of the scene. Depths are
    from the water's surface down. Raises DenseError where cells are too small for the extent.
    """
    place, crs = scene.georeference or UNPLACED, None
    if scene.georeference is not None:
        crs = outputs.crs or place.name
    if outputs.laz:
        _write_points(points, scene, place, crs, folder, recorder)
    if not (outputs.geotiff or outputs.contours):
        return {}
    mapped = OnMap(points, place)
    grid, near = grid_of(mapped, outputs.raster_cell)
    metrics = write_rasters(mapped, grid, near, place, crs, outputs, folder, recorder)
    if outputs.contours or (outputs.geotiff and outputs.orthophoto):
        raster = raster_in_grid(mapped, grid, near)
        if outputs.contours:
            write_contours(raster, folder / CONTOURS, outputs.contours, crs)
        if outputs.geotiff and outputs.orthophoto:
            _write_orthophoto(raster, scene, place, crs, folder, recorder)
    return metrics | {f"gsd_{scene.length_unit}": _pixel(points, scene)}


@dataclass(frozen=True)
class OnMap:
    """Points whose x and y are easting and northing, and z the height above the water below or above them."""

    points: Points
    place: Georeference

    @property
    def length_unit(self) -> str:
        return self.points.length_unit

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: Int[Tensor, " k"]) -> DenseCloud:
        cloud = self.points[rows]
        above = cloud.points[:, 2:] / self.place.level_from_local[2, 2]
        return replace(cloud, points=torch.cat((self.place.coordinates(cloud.points)[:, :2], above), dim=-1))


def _write_points(
    points: Points, scene: Scene, place: Georeference, crs: str | None, folder: Path, recorder: Recorder
) -> None:
    extent = extent_of(place.coordinates(cloud.points) for _, cloud in in_chunks(points))
    ties = tie_points(scene, place)
    with recorder.meter(len(points) + len(ties), "writing LAZ", "point") as advance:
        parts = (dense_points(cloud, scene, place) for _, cloud in in_chunks(points))
        write_las(parts, folder / DENSE_LAZ, extent, crs, advance)
        write_las([ties], folder / POINTS_LAZ, extent_of([ties.coordinates]), crs, advance)


def write_rasters(
    points: Points,
    grid: RasterGrid,
    near: Bool[Tensor, " n"],
    place: Georeference,
    crs: str | None,
    outputs: DenseOutputs,
    folder: Path,
    recorder: Recorder,
) -> dict[str, Any]:
    """Write the rasters of a cloud, tile by tile; metrics of its bed, see `BedStatistics`.

    points: a cloud, or a file of one, whose x and y are on the map and z above the water; grid and near: see `grid_of`.
    """
    unit, bed = points.length_unit, BedStatistics(grid.cell_size)
    where = Place(grid, unit, crs)
    with ExitStack() as open_files:
        files = {
            name: open_files.enter_context(band_file(folder / RASTERS[name], bands, where, of))
            for name, (bands, of) in (_bands(unit) if outputs.geotiff else {}).items()
        }
        tiles = raster_tiles(points, grid, near)
        for tile in recorder.track(tiles, count_tiles(grid), "writing rasters", "tile"):
            bed.add(tile)
            _write_tile(tile, files, place)
    return bed.metrics(unit)


def _bands(unit: str) -> dict[str, tuple[tuple[str, ...], str]]:
    """Of each raster the names of its bands, and their unit."""
    return {
        "dsm": (("height",), unit),
        "depth": (("depth",), unit),
        "sigma": (("sigma", "tvu_95"), unit),
        "views": (("views",), ""),
        "hillshade": (("hillshade",), ""),
    }


def _write_tile(tile: Tile, files: Mapping[str, BandFile], place: Georeference) -> None:
    raster = tile.raster
    shade = 1.0 + 254.0 * hillshade(raster.depth, raster.valid, raster.cell_size)
    values = {
        "dsm": (raster.height + place.water_heights(raster.x, raster.y[:, None]),),
        "depth": (raster.depth,),
        "sigma": (raster.sigma, vertical_uncertainty(raster.sigma)),
        "views": (raster.views,),
        "hillshade": (shade,),
    }
    for name, file in files.items():
        valid = raster.valid & (raster.height < 0.0) if name == "depth" else raster.valid
        file.write([tile.inner(grid) for grid in values[name]], tile.inner(valid), tile.row, tile.column)


def _write_orthophoto(
    raster: Raster, scene: Scene, place: Georeference, crs: str | None, folder: Path, recorder: Recorder
) -> None:
    local = _in_scene(raster, place)
    level = moved(scene, Similarity(torch.ones(()).double(), place.level_from_local, torch.zeros(3).double()))
    colored = orthophoto(local, level, Images(photographs(scene)), recorder)
    where = replace(colored, x_west=raster.x_west, y_north=raster.y_north, cell_size=colored.cell_size * place.scale)
    with color_file(folder / RASTERS["orthophoto"], Place.of(where, crs)) as file:
        file.write_colors(colored.colors, colored.valid, 0, 0)


def _pixel(points: Points, scene: Scene) -> float:
    """How far a pixel reaches on the surface, in the median of some points: seen straight, which is less by a tenth at
    most."""
    cloud = points[thin(torch.arange(len(points)), SAMPLE)]
    away = (scene.views.center[cloud.reference] - cloud.points).norm(dim=-1)
    focal = scene.cameras.focal[scene.views.camera[cloud.reference]].mean(dim=-1)
    return float((away / focal).median())


def dense_points(cloud: DenseCloud, scene: Scene, place: Georeference) -> LasPoints:
    """A dense cloud as it is written on the map."""
    unit = cloud.length_unit
    depth = (-cloud.points[:, 2]).clamp(min=0.0)
    axes = _axes(cloud.axis_sigma, unit)
    extra = {
        "depth": (depth, f"below the water's surface ({unit})"),
        "incidence": (_incidence(cloud, scene), "of its ray at the water (degree)"),
        "views": (cloud.views, "images that see it"),
        "score": (cloud.score, "correlation of these images"),
    }
    coordinates = place.coordinates(cloud.points)
    return LasPoints(coordinates, cloud.colors, _classes(cloud.points[:, 2]), axes | extra)


def tie_points(scene: Scene, place: Georeference) -> LasPoints:
    """The sparse points of a scene as they are written on the map."""
    rows = scene.placed.nonzero()[:, 0]
    points, unit = scene.points[rows], scene.length_unit
    extra: Extra = {
        "depth": ((-points[:, 2]).clamp(min=0.0), f"below the water's surface ({unit})"),
        "views": (scene.sightings()[rows], "images that see it"),
    }
    covariance = scene.assessment.point_covariance
    if covariance is not None and len(covariance) == len(scene.points):
        extra |= _axes(covariance[rows].diagonal(dim1=1, dim2=2).clamp(min=0.0).sqrt(), unit)
    classes = _classes(points[:, 2])
    if scene.dry is not None:
        classes = classes.where(~scene.dry[rows], int(PointClass.GROUND))
    return LasPoints(place.coordinates(points), scene.colors[rows], classes, extra)


def _axes(sigma: Float[Tensor, "n 3"], unit: str) -> Extra:
    return {
        f"sigma_{name}": (values, f"standard deviation ({unit})") for name, values in zip("xyz", sigma.T, strict=True)
    }


def _classes(z: Float[Tensor, " n"]) -> Int[Tensor, " n"]:
    return torch.where(z < 0.0, int(PointClass.BATHYMETRIC), int(PointClass.GROUND))


def _incidence(cloud: DenseCloud, scene: Scene) -> Float[Tensor, " n"]:
    """Angle between the vertical and the ray of the reference view in air, degrees."""
    if not len(cloud):
        return cloud.sigma
    camera = scene.camera_of(cloud.reference)
    pixels, _ = camera.project(cloud.points)
    _, in_air, _, _ = camera.follow_rays(pixels)
    return (-in_air[:, 2]).clamp(-1.0, 1.0).acos().rad2deg()


def _in_scene(raster: Raster, place: Georeference) -> Raster:
    """A raster on the map in the frame of the scene, turned level."""
    east, north, height = place.origin
    return replace(
        raster,
        height=raster.height + (place.water_heights(raster.x, raster.y[:, None]) - height),
        x_west=(raster.x_west - east) / place.scale,
        y_north=(raster.y_north - north) / place.scale,
        cell_size=raster.cell_size / place.scale,
    )
