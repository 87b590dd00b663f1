"""What surveyors take from a run: clouds and rasters on the map, with heights in the datum and their uncertainty."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.config import DenseOutputs, OptionError
from torchrefrac.dense.images import Images, photographs
from torchrefrac.dense.orthophoto import orthophoto
from torchrefrac.dense.rasterize import raster_of
from torchrefrac.dense.relief import hillshade
from torchrefrac.evaluate.survey_orders import order_shares, vertical_uncertainty
from torchrefrac.files.contours import write_contours
from torchrefrac.files.geotiff import write_bands, write_image
from torchrefrac.files.las import LasPoints, PointClass, write_las
from torchrefrac.files.run import CONTOURS, DENSE_LAZ, POINTS_LAZ, RASTERS
from torchrefrac.recorder import Recorder
from torchrefrac.scene import DenseCloud, Georeference, Raster, Scene

UNPLACED = Georeference("", (0.0, 0.0, 0.0))
"""Of a scene of which nobody knows where it stands: the numbers in files are those of its own frame."""


def require_place(outputs: DenseOutputs, place: Georeference | None) -> None:
    """Raise OptionError where a reference system is wanted that the scene is not placed in: it would be stamped on
    coordinates of another frame."""
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


def _same(crs: str, place: Georeference) -> bool:
    from pyproj import CRS  # noqa: PLC0415 - of an extra

    return CRS.from_user_input(crs) in (CRS.from_user_input(place.crs), CRS.from_user_input(place.name))


def write_survey_products(
    cloud: DenseCloud, scene: Scene, outputs: DenseOutputs, folder: Path, recorder: Recorder
) -> dict[str, Any]:
    """Write what `outputs` asks for of clouds and rasters on the map, each whole or not at all; metrics of the raster.

    Coordinates are those of the scene's georeference, in float64, heights those of its datum; where it has none, those
    of the scene. Depths are from the water's surface down.
    """
    place, crs = scene.georeference or UNPLACED, None
    if scene.georeference is not None:
        crs = outputs.crs or place.name
    if outputs.laz:
        with recorder.meter(len(cloud) + len(scene.points), "writing LAZ", "point") as advance:
            write_las(dense_points(cloud, scene, place), folder / DENSE_LAZ, crs, advance)
            write_las(tie_points(scene, place), folder / POINTS_LAZ, crs, advance)
    if not (outputs.geotiff or outputs.contours):
        return {}
    flat = replace(cloud, points=_on_map(cloud.points, place))
    raster = raster_of(flat, outputs.raster_cell)
    if outputs.contours:
        write_contours(raster, folder / CONTOURS, outputs.contours, crs)
    if outputs.geotiff:
        _write_rasters(raster, place, crs, folder, recorder)
        if outputs.orthophoto:
            local = replace(raster, **_in_scene(raster, place))
            colored = orthophoto(local, scene, Images(photographs(scene)), recorder)
            back = {"x_west": raster.x_west, "y_north": raster.y_north, "cell_size": colored.cell_size * place.scale}
            write_image(colored.colors, folder / RASTERS["orthophoto"], replace(colored, **back), crs)
    return raster_metrics(raster) | {f"gsd_{scene.length_unit}": _pixel(cloud, scene)}


def _pixel(cloud: DenseCloud, scene: Scene) -> float:
    """How far a pixel reaches on the surface, in the median: seen straight, which is less by a tenth at most."""
    away = (scene.views.center[cloud.reference] - cloud.points).norm(dim=-1)
    focal = scene.cameras.focal[scene.views.camera[cloud.reference]].mean(dim=-1)
    return float((away / focal).median())


def raster_metrics(raster: Raster) -> dict[str, Any]:
    """Of the cells of the bed, with UNIT the length unit: bed_area_UNIT2, depth_median_UNIT and depth_99_percent_UNIT
    (so much of it is not deeper), bed_sigma_median_UNIT, and s44_NAME_percent, the share that each order of S-44
    allows."""
    unit, bed = raster.length_unit, raster.valid & (raster.height < 0.0)
    depth, sigma = raster.depth[bed], raster.sigma[bed]
    if not len(depth):
        return {}
    known = {
        f"bed_area_{unit}2": len(depth) * raster.cell_size**2,
        f"depth_median_{unit}": float(depth.median()),
        f"depth_99_percent_{unit}": float(depth.sort().values[int(0.99 * (len(depth) - 1))]),
        f"bed_sigma_median_{unit}": float(sigma.median()),
    }
    shares = order_shares(depth, sigma, unit)
    return known | {f"s44_{name}_percent": round(100.0 * share, 2) for name, share in shares.items()}


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
    extra: dict[str, tuple[Tensor, str]] = {
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


def _axes(sigma: Float[Tensor, "n 3"], unit: str) -> dict[str, tuple[Tensor, str]]:
    return {
        f"sigma_{name}": (values, f"standard deviation ({unit})") for name, values in zip("xyz", sigma.T, strict=True)
    }


def _classes(z: Float[Tensor, " n"]) -> Int[Tensor, " n"]:
    bed, land = (
        torch.full_like(z, int(kind), dtype=torch.long) for kind in (PointClass.BATHYMETRIC, PointClass.GROUND)
    )
    return torch.where(z < 0.0, bed, land)


def _incidence(cloud: DenseCloud, scene: Scene) -> Float[Tensor, " n"]:
    """Angle between the vertical and the ray of the reference view in air, degrees."""
    if not len(cloud):
        return cloud.sigma
    camera = scene.camera_of(cloud.reference)
    pixels, _ = camera.project(cloud.points)
    _, in_air, _, _ = camera.follow_rays(pixels)
    return (-in_air[:, 2]).clamp(-1.0, 1.0).acos().rad2deg()


def _on_map(points: Float[Tensor, "n 3"], place: Georeference) -> Float[Tensor, "n 3"]:
    """Easting and northing, but the height above the water."""
    return torch.cat((place.coordinates(points)[:, :2], points[:, 2:]), dim=-1)


def _in_scene(raster: Raster, place: Georeference) -> dict[str, float]:
    """Where a raster on the map lies in the frame of the scene."""
    east, north, _ = place.origin
    return {
        "x_west": (raster.x_west - east) / place.scale,
        "y_north": (raster.y_north - north) / place.scale,
        "cell_size": raster.cell_size / place.scale,
    }


def _write_rasters(raster: Raster, place: Georeference, crs: str | None, folder: Path, recorder: Recorder) -> None:
    unit, bed = raster.length_unit, replace(raster, valid=raster.valid & (raster.height < 0.0))
    shade = 1.0 + 254.0 * hillshade(raster.depth, raster.valid, raster.cell_size)
    uncertainty = {"sigma": raster.sigma, "tvu_95": vertical_uncertainty(raster.sigma)}
    every = (
        ("dsm", {"height": raster.height + place.origin[2]}, raster, unit),
        ("depth", {"depth": raster.depth}, bed, unit),
        ("sigma", uncertainty, raster, unit),
        ("views", {"views": raster.views}, raster, ""),
        ("hillshade", {"hillshade": shade}, raster, ""),
    )
    for name, bands, where, of in recorder.track(every, len(every), "writing GeoTIFF", "raster"):
        write_bands(bands, folder / RASTERS[name], where, of, crs)
