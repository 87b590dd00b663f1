"""Cameras in JSON: size, focal lengths, principal point and distortion, and how uncertain they are."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.camera.intrinsics import MODELS
from torchrefrac.files.fields import Fields
from torchrefrac.files.plausible import implausible
from torchrefrac.scene import Cameras

NUMBERS = ("width", "height", "fx", "fy", "cx", "cy")
MOST_UNCERTAIN = {"focal": 1.0, "principal_point": 1e5, "distortion": 10.0}
"""Of standard deviations: of focal lengths relative, of principal points in pixels, of coefficients."""


def read_cameras_table(cameras: dict[str, Fields], shift: float = 0.0) -> Cameras:
    """Cameras by their names, which state what they are and how uncertain that is."""
    every, sigmas = [], []
    for fields in cameras.values():
        fields.only("model", *NUMBERS, "distortion", "sigma")
        every.append(read_intrinsics(fields, shift))
        sigmas.append(_sigma(fields))
    table = Cameras.of(every, tuple(cameras))
    columns = zip(*sigmas, strict=True)
    focal, middle, distortion = (torch.tensor(column, dtype=torch.float64) for column in columns)
    return replace(table, focal_sigma=focal, principal_point_sigma=middle, distortion_sigma=distortion)


def camera_of_images(images: Sequence[Fields], cameras: Cameras) -> list[int]:
    """The row of the camera of each image, which may leave out its name where there is only one."""
    rows = {name: row for row, name in enumerate(cameras.names)}
    found = []
    for image in images:
        if "camera" not in image and len(cameras) > 1:
            raise image.fail("camera", f"is missing, but there are several cameras: {', '.join(rows)}")
        name = image.text("camera", cameras.names[0])
        if name not in rows:
            raise image.fail("camera", f"is {name!r}, but cameras has {', '.join(rows)}")
        found.append(rows[name])
    return found


def read_intrinsics(fields: Fields, shift: float = 0.0, counts: Sequence[int] = ()) -> Intrinsics:
    """Size, focal lengths, principal point, which is moved by `shift` pixels both ways, and distortion: of as many
    coefficients as one of `counts` says, by default as the model has."""
    width, height = fields.integer("width"), fields.integer("height")
    focal, (cx, cy) = ((fields.number(x), fields.number(y)) for x, y in (("fx", "fy"), ("cx", "cy")))
    for name, value in zip(("width", "height", "fx", "fy"), (width, height, *focal), strict=True):
        if value <= 0:
            raise fields.fail(name, f"is {value:g}, but must be above 0")
    model = fields.must_be("model", *MODELS) if "model" in fields else "opencv"
    distortion = fields.numbers("distortion", *(counts or MODELS[model])) if "distortion" in fields else ()
    intrinsics = Intrinsics.create(width, height, focal, (cx + shift, cy + shift), distortion, model=model)
    if (wrong := implausible(intrinsics)) is not None:
        raise fields.fail(*wrong)
    return intrinsics


def intrinsics_content(intrinsics: Intrinsics) -> dict[str, Any]:
    """What `read_intrinsics` reads."""
    numbers = (intrinsics.width, intrinsics.height, *intrinsics.focal.tolist(), *intrinsics.principal_point.tolist())
    named = dict(zip(NUMBERS, numbers, strict=True))
    distortion = intrinsics.distortion.tolist()
    if intrinsics.fisheye is not None:
        return {"model": "fisheye", **named, "distortion": distortion[:4]}
    return {**named, "distortion": distortion}


def cameras_content(cameras: Cameras) -> dict[str, Any]:
    """What `read_cameras_table` reads."""
    content = {}
    for row, name in enumerate(cameras.names):
        sigmas = {key: float(getattr(cameras, f"{key}_sigma")[row]) for key in MOST_UNCERTAIN}
        known = {key: sigma for key, sigma in sigmas.items() if sigma > 0.0}
        content[name] = {**intrinsics_content(cameras[row]), **({"sigma": known} if known else {})}
    return content


def _sigma(fields: Fields) -> list[float]:
    """Of the focal lengths, the principal point and the coefficients; 0 where they count as exact."""
    if "sigma" not in fields:
        return [0.0] * len(MOST_UNCERTAIN)
    sigma = fields.object("sigma")
    sigma.only(*MOST_UNCERTAIN)
    return [sigma.positive(name, most) if name in sigma else 0.0 for name, most in MOST_UNCERTAIN.items()]
