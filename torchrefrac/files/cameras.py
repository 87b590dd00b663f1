"""`cameras.json` and `points.ply`: what a run leaves behind, written whole or not at all."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.files.colmap.model import read_colmap
from torchrefrac.files.fields import Fields, different_names, scene_fields, write_json
from torchrefrac.files.georeference import GEOREFERENCE, georeference_content, read_georeference
from torchrefrac.files.interface import INTERFACES, interface_content, read_placed
from torchrefrac.files.intrinsics import (
    camera_of_images,
    cameras_content,
    intrinsics_content,
    read_cameras_table,
    read_intrinsics,
)
from torchrefrac.files.ply import kind_of_coordinates, write_vertices
from torchrefrac.files.swap import settle
from torchrefrac.files.transforms import TRANSFORMS, read_transforms
from torchrefrac.files.water import WATER, with_water
from torchrefrac.geometry import Rigid
from torchrefrac.scene import (
    Assessment,
    Cameras,
    Interfaces,
    Observations,
    Scene,
    Views,
    largest_deviation,
    mean_deviation,
)
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.scene.tables import PLAIN

CAMERAS, POINTS, FORMAT, SEVERAL = "cameras.json", "points.ply", "torchrefrac-cameras/1", "torchrefrac-cameras/2"
"""The second format has a table of cameras; the first is written where there is one, with five coefficients."""
LEVELS = "torchrefrac-cameras/3"
"""The same with several water surfaces, of as many epochs: their heights, and which of them an image has."""
PLACES = "torchrefrac-cameras/4"
"""The same with any interfaces: what they are and where, and which of them an image looks through."""


@dataclass(frozen=True, eq=False)
class NamedCameras(RefractiveCamera):
    """Cameras as one batch (m), and the names (m) of their photographs."""

    names: tuple[str, ...] = field(kw_only=True)


def load_cameras(run: str | Path) -> NamedCameras:
    """The cameras of the registered views of a run, from its folder or its cameras.json; or those of a training set or
    a COLMAP model that `torchrefrac export` wrote, from its folder, with the water of the water.json there.

    Raises SceneError, with the file and the field, for anything that cannot be right.
    """
    run = Path(run)
    settle(run)
    if run.is_dir() and not (run / CAMERAS).is_file() and (run / WATER).is_file():
        scene = read_transforms(run / TRANSFORMS) if (run / TRANSFORMS).is_file() else read_colmap(run)
        return named_cameras(with_water(scene, run / WATER))
    scene = read_cameras(run / CAMERAS if run.is_dir() else run)
    return named_cameras(scene.of_views(scene.views.registered))


def named_cameras(scene: Scene) -> NamedCameras:
    """All views of a scene as one batch."""
    of, views = scene.camera_of(), scene.views
    intrinsics = scene.cameras.of_views(views.camera, coefficients=5)
    return NamedCameras(intrinsics, views.rotation, views.center, of.interface, check=False, names=views.names)


def write_cameras(scene: Scene, path: Path) -> None:
    """Write poses, intrinsics, index ratio and, where it is known, the covariance of each registered view's centre, in
    squares of the length unit; the frame and the convention of pixels are those of the package, and where the frame
    stands on Earth, if that is known.
    """
    cameras, views, interfaces = scene.cameras, scene.views, scene.interfaces
    plain = interfaces.are_horizontal and set(interfaces.kinds) == {SURFACE} and not interfaces.has_layers
    epochs = plain and len(interfaces) > 1
    placed = not (epochs or (plain and interfaces.is_level))
    several = placed or epochs or len(cameras) != 1 or cameras.models != (PLAIN,) or cameras.coefficients > 5
    covariance = scene.assessment.center_covariance
    covariances = iter([] if covariance is None else covariance.tolist())
    images: list[dict[str, object]] = []
    for i, (name, registered) in enumerate(zip(views.names, views.registered.tolist(), strict=True)):
        entry: dict[str, object] = {"name": name, "registered": registered}
        if several:
            entry["camera"] = cameras.names[int(views.camera[i])]
        if epochs:
            entry["water"] = int(views.interface[i])
        elif placed:
            entry["interface"] = int(views.interface[i])
        if registered:
            entry["cam_from_world_rotation"] = views.rotation[i].tolist()
            entry["center_in_world"] = views.center[i].tolist()
            if covariance is not None:
                entry["center_covariance"] = next(covariances)
        else:
            entry["reason"] = scene.failures.get(name, "")
        images.append(entry)
    known: dict[str, object] = {
        "length_unit": scene.length_unit,
        "index_ratio": scene.index_ratio,
        "pixel_origin": "corner",
    }
    if epochs:
        known["water_levels"] = interfaces.offset.tolist()
    elif placed:
        known[INTERFACES] = [interface_content(interfaces, row) for row in range(len(interfaces))]
    if scene.georeference is not None:
        known[GEOREFERENCE] = georeference_content(scene.georeference)
    lenses: dict[str, object] = {"cameras": cameras_content(cameras)}
    if not several:
        lenses = {"intrinsics": intrinsics_content(cameras[0])}
    kind = PLACES if placed else LEVELS if epochs else SEVERAL if several else FORMAT
    write_json({"format": kind, **known, **lenses, "images": images}, path)


def read_cameras(path: Path) -> Scene:
    """Read `cameras.json`: the views of a run, registered or not, without points, and of the assessment that of the
    centres. Raises SceneError, with the file and the field, for anything that cannot be right."""
    with scene_fields(path) as top:
        several = top.must_be("format", FORMAT, SEVERAL, LEVELS, PLACES) != FORMAT
        top.must_be("pixel_origin", "corner")
        if top.number("index_ratio") < 1.0:
            raise top.fail("index_ratio", f"is {top.number('index_ratio'):g}, but must be at least 1")
        images = top.objects("images")
        names = different_names(images)
        known = torch.tensor([image.flag("registered") for image in images], dtype=torch.bool)
        registered = [image for image in images if image.flag("registered")]
        pose = Rigid.identity(len(images))
        pose.rotation[known] = _table([image.rotation("cam_from_world_rotation") for image in registered], 3, 3)
        pose.center[known] = _table([image.position("center_in_world") for image in registered], 3)
        cameras = read_cameras_table(top.members("cameras")) if several else _only(top.object("intrinsics"))
        camera = torch.tensor(camera_of_images(images, cameras)) if several else None
        interfaces, water = _water(top, images)
        none = torch.zeros(0, 3, dtype=torch.float64)
        return Scene(
            cameras=cameras,
            views=replace(Views.posed(pose, names, camera, water), registered=known),
            interfaces=interfaces,
            points=none,
            colors=none.to(torch.uint8),
            placed=torch.zeros(0, dtype=torch.bool),
            observations=Observations.none(),
            accepted=torch.zeros(0, dtype=torch.bool),
            length_unit=top.length_unit(),
            failures={image.text("name"): image.text("reason", "") for image in images if not image.flag("registered")},
            assessment=_assessment(registered),
            georeference=read_georeference(top, of_water=True),
        )


def _water(top: Fields, images: Sequence[Fields]) -> tuple[Interfaces, Int[Tensor, " m"] | None]:
    """The surfaces, and which of them each image has; None where there is one."""
    one = Interfaces.level(top.number("index_ratio"))
    if top.text("format") == PLACES:
        surfaces = read_placed(top)
        return surfaces, _rows(images, "interface", INTERFACES, len(surfaces))
    if top.text("format") != LEVELS:
        return one, None
    levels = torch.tensor(top.number_list("water_levels"), dtype=torch.float64)
    surfaces = replace(one.repeated(len(levels)), offset=levels)
    return surfaces, _rows(images, "water", "water_levels", len(levels))


def _rows(images: Sequence[Fields], name: str, table: str, count: int) -> Int[Tensor, " m"]:
    rows = [image.integer(name) for image in images]
    for image, row in zip(images, rows, strict=True):
        if not 0 <= row < count:
            raise image.fail(name, f"is {row}, but must lie in 0 to {count - 1}, one of {table}")
    return torch.tensor(rows)


def _only(intrinsics: Fields) -> Cameras:
    return Cameras.of([read_intrinsics(intrinsics, counts=(5,))])


def _table(rows: Sequence[Any], *shape: int) -> Float[Tensor, "m *shape"]:
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, *shape)


def _assessment(registered: list[Fields]) -> Assessment:
    """Of the centres of registered views, where the file has the covariances of all of them."""
    if not registered or not all("center_covariance" in image for image in registered):
        return Assessment()
    covariance = _table([image.matrix("center_covariance") for image in registered], 3, 3)
    return Assessment(center_sigma=mean_deviation(covariance), center_covariance=covariance)


def write_points(
    points: Float[Tensor, "n 3"],
    colors: UInt8[Tensor, "n 3"],
    path: Path,
    known: Assessment | None = None,
    dry: Bool[Tensor, " n"] | None = None,
) -> None:
    """Write a coloured point cloud as binary PLY.

    Coordinates are float32, or float64 where that would round away what is known of them, as far from the origin of a
    map. known: of these points, written as properties of the vertices (float32): `sigma` along the axis in which each
    is known worst, `sigma_x`, `sigma_y`, `sigma_z`, and `sigma_relative`, along the worst axis as if cameras and water
    were known. dry: which of them are seen straight although they lie below the water's level, as the property `dry`
    (1: yes).
    """
    sigma = None if known is None else known.point_sigma
    kind = kind_of_coordinates(points, sigma)
    columns = [(name, kind, value) for name, value in zip("xyz", points.T, strict=True)]
    columns += [(name, "u1", value) for name, value in zip(("red", "green", "blue"), colors.T, strict=True)]
    if known is not None and sigma is not None and known.point_covariance is not None:
        along = known.point_covariance.diagonal(dim1=1, dim2=2).clamp(min=0.0).sqrt()
        columns.append(("sigma", "f4", sigma))
        columns += [(f"sigma_{name}", "f4", value) for name, value in zip("xyz", along.T, strict=True)]
        if known.relative_covariance is not None:
            columns.append(("sigma_relative", "f4", largest_deviation(known.relative_covariance)))
    if dry is not None:
        columns.append(("dry", "u1", dry))
    write_vertices(columns, path)


def load_points(path: Path) -> tuple[Float[Tensor, "n 3"], UInt8[Tensor, "n 3"]]:
    """Points (float64) and colours of a PLY file."""
    import trimesh  # noqa: PLC0415 - slow to import, needed only here

    cloud = trimesh.load(path, process=False)
    colors = np.asarray(cloud.visual.vertex_colors if hasattr(cloud, "visual") else cloud.colors)  # type: ignore[union-attr]
    points = torch.from_numpy(np.array(cloud.vertices, dtype=np.float64))  # type: ignore[union-attr]
    return points, torch.from_numpy(np.array(colors[:, :3], dtype=np.uint8))
