"""`cameras.json` and `points.ply`: what a run leaves behind, written whole or not at all."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.files.fields import Fields, scene_fields
from torchrefrac.files.ply import write_vertices
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Assessment, Cameras, Interfaces, Observations, Scene, SceneError, Views, mean_deviation

CAMERAS, FORMAT = "cameras.json", "torchrefrac-cameras/1"
UNKNOWN = ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0, 0.0])  # the pose of what has none


@dataclass(frozen=True, eq=False)
class NamedCameras(RefractiveCamera):
    """Cameras as one batch (m), and the names (m) of their photographs."""

    names: tuple[str, ...] = field(kw_only=True)


def load_cameras(run: str | Path) -> NamedCameras:
    """The cameras of the registered views of a run, from its folder or its cameras.json.

    Raises SceneError, with the file and the field, for anything that cannot be right.
    """
    run = Path(run)
    scene = read_cameras(run / CAMERAS if run.is_dir() else run)
    scene = scene.of_views(scene.views.registered)
    of, views = scene.camera_of(), scene.views
    return NamedCameras(of.intrinsics, views.rotation, views.center, of.interface, check=False, names=views.names)


def write_cameras(scene: Scene, path: Path) -> None:
    """Write poses, intrinsics, index ratio and, where it is known, the covariance of each registered view's centre, in
    squares of the length unit; the frame and the convention of pixels are those of the package.

    Raises SceneError where there are several cameras, or water that is not the plane z = 0: the file has no place for
    them.
    """
    intrinsics, views = scene.intrinsics, scene.views
    if not scene.interfaces.is_level:
        raise SceneError(
            f"{path} cannot tell of water that is not the plane z = 0; write a COLMAP model and water.json"
        )
    (fx, fy), (cx, cy) = intrinsics.focal.tolist(), intrinsics.principal_point.tolist()
    covariance = scene.assessment.center_covariance
    covariances = iter([] if covariance is None else covariance.tolist())
    images: list[dict[str, object]] = []
    for i, (name, registered) in enumerate(zip(views.names, views.registered.tolist(), strict=True)):
        entry: dict[str, object] = {"name": name, "registered": registered}
        if registered:
            entry["cam_from_world_rotation"] = views.rotation[i].tolist()
            entry["center_in_world"] = views.center[i].tolist()
            if covariance is not None:
                entry["center_covariance"] = next(covariances)
        else:
            entry["reason"] = scene.failures.get(name, "")
        images.append(entry)
    content = {
        "format": FORMAT,
        "length_unit": scene.length_unit,
        "index_ratio": scene.index_ratio,
        "pixel_origin": "corner",
        "intrinsics": {
            **{"width": intrinsics.width, "height": intrinsics.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy},
            "distortion": intrinsics.distortion.tolist(),
        },
        "images": images,
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_cameras(path: Path) -> Scene:
    """Read `cameras.json`: the views of a run, registered or not, without points, and of the assessment that of the
    centres. Raises SceneError, with the file and the field, for anything that cannot be right."""
    with scene_fields(path) as top:
        for name, wanted in (("format", FORMAT), ("pixel_origin", "corner")):
            if top.text(name) != wanted:
                raise top.fail(name, f"is {top.text(name)!r}, but must be {wanted!r}")
        if top.number("index_ratio") < 1.0:
            raise top.fail("index_ratio", f"is {top.number('index_ratio'):g}, but must be at least 1")
        images = top.objects("images")
        names = _names(images)
        registered = [image.flag("registered") for image in images]
        poses = [_pose(image) if known else UNKNOWN for image, known in zip(images, registered, strict=True)]
        pose = Rigid(_table([rotation for rotation, _ in poses], 3, 3), _table([center for _, center in poses], 3))
        none = torch.zeros(0, 3, dtype=torch.float64)
        return Scene(
            cameras=Cameras.of([_intrinsics(top.object("intrinsics"))]),
            views=replace(Views.posed(pose, names), registered=torch.tensor(registered, dtype=torch.bool)),
            interfaces=Interfaces.level(top.number("index_ratio")),
            points=none,
            colors=none.to(torch.uint8),
            placed=torch.zeros(0, dtype=torch.bool),
            observations=Observations.none(),
            accepted=torch.zeros(0, dtype=torch.bool),
            length_unit=top.text("length_unit"),
            failures={image.text("name"): image.text("reason", "") for image in images if not image.flag("registered")},
            assessment=_assessment([image for image in images if image.flag("registered")]),
        )


def _intrinsics(fields: Fields) -> Intrinsics:
    for name in ("width", "height", "fx", "fy"):
        if fields.number(name) <= 0:
            raise fields.fail(name, f"is {fields.number(name):g}, but must be above 0")
    focal, principal_point = ((fields.number(x), fields.number(y)) for x, y in (("fx", "fy"), ("cx", "cy")))
    width, height = fields.integer("width"), fields.integer("height")
    return Intrinsics.create(width, height, focal, principal_point, fields.numbers("distortion", 5))


def _pose(image: Fields) -> tuple[list[list[float]], list[float]]:
    return image.matrix("cam_from_world_rotation"), image.numbers("center_in_world", 3)


def _table(rows: Sequence[Any], *shape: int) -> Float[Tensor, "m *shape"]:
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, *shape)


def _names(images: list[Fields]) -> tuple[str, ...]:
    names: list[str] = []
    for image in images:
        if image.text("name") in names:
            raise image.fail(
                "name", f"is {image.text('name')!r}, which an image before it already has; names must differ"
            )
        names.append(image.text("name"))
    return tuple(names)


def _assessment(registered: list[Fields]) -> Assessment:
    """Of the centres of registered views, where the file has the covariances of all of them."""
    if not registered or not all("center_covariance" in image for image in registered):
        return Assessment()
    covariance = _table([image.matrix("center_covariance") for image in registered], 3, 3)
    return Assessment(center_sigma=mean_deviation(covariance), center_covariance=covariance)


def write_points(
    points: Float[Tensor, "n 3"], colors: UInt8[Tensor, "n 3"], path: Path, sigma: Float[Tensor, " n"] | None = None
) -> None:
    """Write a coloured point cloud as binary PLY.

    sigma: standard deviations of the points, written as the property `sigma` of the vertices (float32).
    """
    columns = [(name, "f4", value) for name, value in zip("xyz", points.T, strict=True)]
    columns += [(name, "u1", value) for name, value in zip(("red", "green", "blue"), colors.T, strict=True)]
    if sigma is not None:
        columns.append(("sigma", "f4", sigma))
    write_vertices(columns, path)


def load_points(path: Path) -> tuple[Float[Tensor, "n 3"], UInt8[Tensor, "n 3"]]:
    """Points (float64) and colours of a PLY file."""
    import trimesh  # noqa: PLC0415 - slow to import, needed only here

    cloud = trimesh.load(path, process=False)
    colors = np.asarray(cloud.visual.vertex_colors if hasattr(cloud, "visual") else cloud.colors)  # type: ignore[union-attr]
    points = torch.from_numpy(np.array(cloud.vertices, dtype=np.float64))  # type: ignore[union-attr]
    return points, torch.from_numpy(np.array(colors[:, :3], dtype=np.uint8))
