"""A camera in a file of its own: what `torchrefrac calibrate` writes and `torchrefrac import` takes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrefrac.files.capture import pixel_shift
from torchrefrac.files.fields import read_json, write_json
from torchrefrac.files.metadata.lens import Lens
from torchrefrac.scene.capture import CaptureError

FORMAT = "torchrefrac-camera/1"
MODELS = {"opencv": (0, 4, 5, 8), "fisheye": (4,)}  # how many coefficients of distortion each may have


def write_camera(path: Path, size: tuple[int, int], lens: Lens, about: Mapping[str, Any]) -> None:
    """about: what else is to be told of the calibration."""
    numbers = (*size, *lens.focal, *lens.principal_point)
    named = dict(zip(("width", "height", "fx", "fy", "cx", "cy"), numbers, strict=True))
    camera = {"model": lens.model, **named, "distortion": list(lens.distortion), "sigma": {"focal": lens.sigma}}
    write_json({"format": FORMAT, "pixel_origin": "corner", "camera": camera, **about}, path)


def read_camera(path: Path) -> tuple[tuple[int, int], Lens]:
    """Width and height, and the lens. Raises CaptureError for whatever is wrong with the file."""
    top = read_json(path, "does not exist, but camera must be a file that `torchrefrac calibrate` wrote")
    top.must_be("format", FORMAT)
    shift = pixel_shift(top, top.text("pixel_origin"))
    fields = top.object("camera")
    model = fields.text("model")
    if model not in MODELS:
        raise fields.fail("model", f"is {model!r}, but must be one of {', '.join(MODELS)}")
    counts = [count for count in MODELS[model] if fields.has_length("distortion", count)]
    distortion = fields.numbers("distortion", counts[0] if counts else MODELS[model][-1])
    fx, fy, cx, cy = (fields.number(name) for name in ("fx", "fy", "cx", "cy"))
    sigma = fields.object("sigma").number("focal")
    if min(fx, fy, sigma) <= 0.0:
        raise CaptureError(f"{path}: fx, fy and sigma.focal must be above 0; calibrate again")
    source = path.name
    lens = Lens((fx, fy), (cx + shift, cy + shift), tuple(distortion), sigma, source, source, source, model)
    return (fields.integer("width"), fields.integer("height")), lens


def lens_for(path: Path, size: tuple[int, int]) -> Lens:
    """The lens of a file for photographs of some size: that of the calibration, or scaled to photographs that are
    smaller or larger in both ways alike. Raises CaptureError where they have other sides."""
    calibrated, lens = read_camera(path)
    ratio = size[0] / calibrated[0]
    if abs(size[1] - ratio * calibrated[1]) > 1.0:
        found, wanted = (f"{width}x{height}" for width, height in (size, calibrated))
        raise CaptureError(f"{path} is of photographs of {wanted}, but these are {found}; calibrate with such")
    focal, center = ([ratio * number for number in numbers] for numbers in (lens.focal, lens.principal_point))
    return Lens(
        (focal[0], focal[1]), (center[0], center[1]), lens.distortion, lens.sigma, lens.source, lens.center_source,
        lens.distortion_source, lens.model,
    )  # fmt: skip
