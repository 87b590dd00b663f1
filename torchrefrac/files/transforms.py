"""`transforms.json`, as nerfstudio reads it: cameras of a radiance field, which knows no water."""

from collections.abc import Mapping
from pathlib import Path

import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.files.fields import Fields, scene_fields, write_json
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces, Observations, Scene, SceneError
from torchrefrac.scene.tables import FISHEYE, PLAIN

TRANSFORMS, MODELS = "transforms.json", {PLAIN: "OPENCV", FISHEYE: "OPENCV_FISHEYE"}
OPENGL = (1.0, -1.0, -1.0)
"""Its cameras look along -z, with y up."""
FOCAL_AND_MIDDLE = ("fl_x", "fl_y", "cx", "cy")
NAMES = {PLAIN: ("k1", "k2", "p1", "p2", "k3"), FISHEYE: ("k1", "k2", "k3", "k4")}
"""Of coefficients of distortion, in our order; zero where they are missing."""
Lens = tuple[float, ...]
"""Width, height, focal lengths, principal point and distortion."""


def write_transforms(
    scene: Scene, path: Path, images: str, masks: Mapping[str, str] | None = None, points: str | None = None
) -> None:
    """Write the registered views of a scene. images: the folder of the photographs; masks: of each of these, by name;
    points: a cloud; all as paths from the folder of the file.

    Raises SceneError for what nerfstudio has no place for: fisheyes beside other lenses, and rational distortion.
    """
    cameras, views = scene.cameras, scene.views
    if len(set(cameras.models)) > 1:
        raise SceneError("some lenses are fisheyes and others are not, which transforms.json has no place for")
    if cameras.coefficients > 5:
        raise SceneError("a lens has the rational distortion of OpenCV, which transforms.json has no place for")
    lenses = [_lens(cameras[camera], cameras.models[camera]) for camera in range(len(cameras))]
    world_from_cam = views.rotation.mT * views.rotation.new_tensor(OPENGL)
    frames: list[dict[str, object]] = []
    for view in views.registered.nonzero()[:, 0].tolist():
        name = views.names[view]
        frame: dict[str, object] = {"file_path": f"{images}/{name}"}
        if masks is not None:
            frame["mask_path"] = masks[name]
        if len(lenses) > 1:
            frame |= lenses[int(views.camera[view])]
        columns = torch.cat((world_from_cam[view], views.center[view, :, None]), dim=1).tolist()
        frames.append(frame | {"transform_matrix": [*columns, [0.0, 0.0, 0.0, 1.0]]})
    content: dict[str, object] = {"camera_model": MODELS[cameras.models[0]], **(lenses[0] if len(lenses) == 1 else {})}
    if points is not None:
        content["ply_file_path"] = points
    write_json(content | {"length_unit": scene.length_unit, "frames": frames}, path)


def read_transforms(path: Path) -> Scene:
    """The cameras of a file that `write_transforms` wrote, or of another of its kind: views without points, and without
    refraction. Raises SceneError, with the file and the field, for anything that cannot be right."""
    with scene_fields(path) as top:
        kinds = {name: model for model, name in MODELS.items()}
        model = kinds[top.must_be("camera_model", *kinds)]
        frames = top.objects("frames")
        if not frames:
            raise top.fail("frames", "is empty, but must list at least one photograph")
        of_frames = [_read_lens(top if "fl_x" in top else frame, model) for frame in frames]
        different = list(dict.fromkeys(of_frames))
        names = [_name(frame) for frame in frames]
        if len(set(names)) < len(names):
            raise top.fail("frames", "has a photograph twice")
        poses = [_read_pose(frame) for frame in frames]
        rotation = torch.tensor([rotation for rotation, _ in poses], dtype=torch.float64) * torch.tensor(OPENGL)
        center = torch.tensor([center for _, center in poses], dtype=torch.float64)
        return Scene.create(
            Rigid(rotation.mT, center),
            [_intrinsics(lens, model) for lens in different],
            Interfaces.level(1.0),
            center.new_zeros(0, 3),
            Observations.none(),
            names=names,
            camera=torch.tensor([different.index(lens) for lens in of_frames]),
            length_unit=top.text("length_unit", "unit"),
        )


def _lens(intrinsics: Intrinsics, model: str) -> dict[str, object]:
    """Sizes in pixels; nerfstudio counts pixels as we do, from the outer corner of the first."""
    numbers = (*intrinsics.focal.tolist(), *intrinsics.principal_point.tolist())
    distortion = (*intrinsics.distortion.tolist(), 0.0, 0.0, 0.0, 0.0, 0.0)
    named = (*zip(FOCAL_AND_MIDDLE, numbers, strict=True), *zip(NAMES[model], distortion, strict=False))
    return {"w": intrinsics.width, "h": intrinsics.height, **dict(named)}


def _read_lens(fields: Fields, model: str) -> Lens:
    numbers = [fields.number(name) for name in FOCAL_AND_MIDDLE]
    distortion = [fields.number(name) if name in fields else 0.0 for name in NAMES[model]]
    for name, value in zip(FOCAL_AND_MIDDLE[:2], numbers[:2], strict=True):
        if value <= 0.0:
            raise fields.fail(name, f"is {value:g}, but must be above 0")
    return (fields.integer("w"), fields.integer("h"), *numbers, *distortion)


def _intrinsics(lens: Lens, model: str) -> Intrinsics:
    width, height, fx, fy, cx, cy, *distortion = lens
    return Intrinsics.create(int(width), int(height), (fx, fy), (cx, cy), distortion, model=model)


def _read_pose(frame: Fields) -> tuple[list[list[float]], list[float]]:
    rows = frame.rows("transform_matrix", 4)
    if len(rows) not in (3, 4):
        raise frame.fail("transform_matrix", f"has {len(rows)} rows, but must have 3 or 4")
    return frame.as_rotation("transform_matrix", [row[:3] for row in rows[:3]]), [row[3] for row in rows[:3]]


def _name(frame: Fields) -> str:
    """That of the photograph below the folder of all."""
    path = frame.text("file_path")
    return path.partition("/")[2] or path
