"""Between the tables of a COLMAP model and a `Scene`: ids resolved, checked and given."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.files.colmap import tables
from torchrefrac.files.colmap.tables import AGAIN, CameraRow, Ids, ImageTable, PointTable
from torchrefrac.geometry import Rigid, rotate
from torchrefrac.geometry.rotation import quaternion_of
from torchrefrac.scene import Cameras, Interfaces, Observations, Scene, SceneError

Rows = Int[np.ndarray, " k"]


def assemble(
    cameras: list[CameraRow],
    images: ImageTable,
    points: PointTable,
    cameras_path: Path,
    images_path: Path,
    points_path: Path,
) -> Scene:
    """Resolve the ids and check that the three files agree."""
    rows = {row.id: row for row in cameras}
    if len(rows) != len(cameras):
        raise SceneError(f"{cameras_path} gives a camera id twice; {AGAIN}")
    used = sorted(set(images.cameras.tolist()))
    for camera in used:
        if camera not in rows:
            name = images.names[int(np.argmax(images.cameras == camera))]
            raise SceneError(f"{images_path}: {name} has camera {camera}, which {cameras_path.name} lacks; {AGAIN}")
    order = _sorted_by_id(images.ids, images_path, "image")
    _check_images(images, images_path)
    feature, image, point = _observations(images, points, images_path, points_path)
    _require_finite(points.positions, points_path, lambda i: f"point {points.ids[i]}", "position")
    point_order = _sorted_by_id(points.ids, points_path, "point")
    image, point = _ranks(order)[image], _ranks(point_order)[point]
    by_point = np.argsort(point, kind="stable")
    rotation = _rotation_of(torch.from_numpy(images.quaternions[order]))
    pixels = torch.from_numpy(images.pixels[feature[by_point]])
    return Scene.create(
        Rigid(rotation, -rotate(rotation.mT, torch.from_numpy(images.translations[order]))),
        _cameras([rows[camera] for camera in used], cameras_path),
        Interfaces.level(1.0),
        torch.from_numpy(points.positions[point_order]),
        Observations(torch.from_numpy(image[by_point]), torch.from_numpy(point[by_point]), pixels),
        names=[images.names[i] for i in order.tolist()],
        camera=torch.from_numpy(np.searchsorted(np.array(used, dtype=np.int64), images.cameras[order])),
        colors=torch.from_numpy(points.colors[point_order]),
    ).cleaned()


def _cameras(rows: list[CameraRow], path: Path) -> Cameras:
    """By their ids, where there are several."""
    names = tuple(str(row.id) for row in rows) if len(rows) > 1 else ()
    cameras = Cameras.of([tables.intrinsics_of(row, path) for row in rows], names)
    return replace(cameras, read_as=tuple(row.model for row in rows))


def _check_images(images: ImageTable, path: Path) -> None:
    if len(set(images.names)) != len(images.names):
        twice = next(name for i, name in enumerate(images.names) if name in images.names[:i])
        raise SceneError(f"{path} has two images with the name {twice}; names must differ, rename one")

    def record(i: int) -> str:
        return f"image {images.ids[i]} ({images.names[i]})"

    _require_finite(images.quaternions, path, record, "quaternion")
    _require_finite(images.translations, path, record, "translation")
    zero = ~images.quaternions.any(axis=1)
    if zero.any():
        raise SceneError(f"{path}: {record(int(zero.argmax()))} has a quaternion of length zero; export it again")


def _observations(
    images: ImageTable, points: PointTable, images_path: Path, points_path: Path
) -> tuple[Rows, Rows, Rows]:
    """Row among the features, row of the image and row of the point of each element of the tracks."""
    point = np.repeat(np.arange(len(points.ids)), points.lengths)
    order = np.argsort(images.ids)
    place = np.searchsorted(images.ids, points.images, sorter=order)
    image = order[np.minimum(place, len(order) - 1)] if len(order) else np.zeros_like(place)

    def record(i: int) -> str:
        return f"feature {points.features[i]} of {images.names[image[i]]}"

    def refuse(wrong: Bool[np.ndarray, " k"], problem: Callable[[int], str]) -> None:
        if wrong.any():
            i = int(wrong.argmax())
            raise SceneError(f"{points_path}: the track of point {points.ids[point[i]]} has {problem(i)}; {AGAIN}")

    unknown = images.ids[image] != points.images if len(order) else np.ones(len(point), dtype=bool)
    refuse(unknown, lambda i: f"image {points.images[i]}, which {images_path.name} lacks")
    count = np.diff(images.starts)[image]
    refuse(
        (points.features < 0) | (points.features >= count),
        lambda i: f"{record(i)}, which has {count[i]} of them",
    )
    feature = images.starts[image] + points.features
    shown = images.points[feature]
    refuse(
        shown != points.ids[point],
        lambda i: f"{record(i)}, for which {images_path.name} has point {shown[i]}",
    )
    missed = images.points != tables.NO_POINT
    missed[feature] = False
    if missed.any():
        i = int(missed.argmax())
        name = images.names[int(np.searchsorted(images.starts, i, side="right")) - 1]
        raise SceneError(
            f"{images_path}: {name} shows point {images.points[i]}, but {points_path.name} has no such point or does "
            f"not list the image in its track; {AGAIN}"
        )
    seen = images.pixels[feature]
    _require_finite(seen, images_path, lambda i: f"{images.names[image[i]]} (feature {points.features[i]})", "pixel")
    return feature, image, point


def _require_finite(values: Float[np.ndarray, "n d"], path: Path, record: Callable[[int], str], what: str) -> None:
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        i = int(finite.argmin())
        raise SceneError(f"{path}: {record(i)} has the {what} {values[i].tolist()}, but it must be finite; remove it")


def _sorted_by_id(ids: Rows, path: Path, kind: str) -> Rows:
    """Rows in the order of their ids, which must differ."""
    order = np.argsort(ids)
    repeated = np.diff(ids[order]) == 0
    if repeated.any():
        twice = ids[order][int(repeated.argmax())]
        raise SceneError(f"{path} gives {kind} {twice} twice; ids must differ, {AGAIN}")
    return order


def _ranks(order: Rows) -> Rows:
    """The new place of each row that is moved to `order`."""
    ranks = np.empty_like(order)
    ranks[order] = np.arange(len(order))
    return ranks


def tables_of(
    scene: Scene, errors: Float[Tensor, "..."] | None, ids: Ids | None
) -> tuple[list[CameraRow], ImageTable, PointTable]:
    """The content of the files, of registered views, with these ids, or ids that count from 1."""
    scene, n = scene.of_views(scene.views.registered), len(scene.points)
    views, m = scene.views, len(scene.views)
    if errors is None:
        errors = torch.full((n,), -1.0)
    elif errors.shape != (n,):
        raise SceneError(f"errors has shape {tuple(errors.shape)}, but must have {(n,)}, one for each point")
    image, point = _array(scene.observations.view), _array(scene.observations.point)
    by_image = np.argsort(image, kind="stable")
    starts = np.concatenate(([0], np.cumsum(np.bincount(image, minlength=m))))
    image_id = np.array([ids.images[name] for name in views.names] if ids else range(1, m + 1), dtype=np.int64)
    camera_id = np.array(ids.cameras if ids else range(1, len(scene.cameras) + 1), dtype=np.int64)
    quaternion = quaternion_of(views.rotation.detach().double())
    images = ImageTable(
        names=views.names,
        ids=image_id,
        quaternions=_array(quaternion),
        translations=_array(-rotate(_rotation_of(quaternion), views.center.detach().double())),
        cameras=camera_id[_array(views.camera)],
        starts=starts,
        pixels=_array(scene.observations.pixels.double())[by_image],
        points=point[by_image] + 1,
    )
    points = PointTable(
        ids=np.arange(1, n + 1),
        positions=_array(scene.points.double()),
        colors=_array(scene.colors),
        errors=_array(errors.double()),
        lengths=np.bincount(point, minlength=n),
        images=image_id[image],
        features=_ranks(by_image) - starts[image],
    )
    cameras = scene.cameras
    models = cameras.read_as or ("",) * len(cameras)
    rows = [tables.row_of(cameras[i], int(camera_id[i]), model) for i, model in enumerate(models)]
    return rows, images, points


def _array(values: Shaped[Tensor, "*shape"]) -> Shaped[np.ndarray, "*shape"]:
    return values.detach().cpu().numpy()


def _rotation_of(quaternion: Float[Tensor, "m 4"]) -> Float[Tensor, "m 3 3"]:
    """Rotation matrices of quaternions wxyz of any length but zero."""
    largest = quaternion.abs().amax(dim=-1, keepdim=True)
    w, x, y, z = torch.nn.functional.normalize(quaternion / largest, dim=-1).unbind(dim=-1)
    entries = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack(entries, dim=-1).reshape(-1, 3, 3)
