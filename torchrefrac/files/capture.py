"""Reading `capture.json` and checking it before anything is computed."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.files.extent import read_extent
from torchrefrac.files.fields import Fields, different_names, read_json
from torchrefrac.files.masks import Masks
from torchrefrac.files.photographs import DamagedPhotographError, check_photograph, read_grey
from torchrefrac.files.plausible import implausible
from torchrefrac.scene import Cameras, Capture, CaptureError, Interfaces, WaterExtent
from torchrefrac.scene.interfaces import INDEX_RATIO_RANGE, MAX_INDEX_RATIO

FORMAT = "torchrefrac-capture/1"
PIXEL_SHIFT = {"center": 0.5, "corner": 0.0}
UNIT_TOLERANCE = 1e-3
OPTICAL_AXIS = [0.0, 0.0, 1.0]
LEAST_HEIGHT, MOST_HEIGHT = 1e-9, 1e9  # in any unit; the sixth powers that covariances need have an exponent


def load_capture(folder: str | Path) -> Capture:
    """Read `folder`/capture.json; the images lie in `folder`/images.

    Images that are damaged or cannot be read are left out and listed in `damaged`, where two or more others are left.
    Raises CaptureError with one sentence for anything else that cannot be right: a missing image, one of another size,
    a mask that fits no image or has another size, a missing or mistyped field, gravity or headings of some images only,
    gravity that is no unit vector, a camera that looks at the sky, an index ratio below 1 or beyond any liquid, an
    extent of the water that is no polygon, fewer than two images, a name given twice.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder} is not a folder; give the folder that holds capture.json and images/")
    top = read_json(folder / "capture.json")
    top.only(
        "format", "length_unit", "index_ratio", "pixel_origin", "intrinsics", "down_in_cam_sigma_deg", "water_extent",
        "images",
    )  # fmt: skip
    top.must_be("format", FORMAT)
    intrinsics = capture_intrinsics(top)
    images = top.objects("images")
    if len(images) < 2:
        raise top.fail("images", f"lists {len(images)}, but a reconstruction needs at least 2")
    names = _names(images)
    paths = tuple(folder / "images" / name for name in names)
    damaged = _damaged(paths, intrinsics)
    has_gravity, has_heading = (any(name in image for image in images) for name in ("down_in_cam", "heading_deg"))
    heights = [_height(image) for image in images]
    down = [_gravity(image) if has_gravity else OPTICAL_AXIS for image in images]
    capture = Capture(
        folder=folder,
        names=names,
        paths=paths,
        cameras=Cameras.of([intrinsics]),
        interfaces=Interfaces.level(read_index_ratio(top)),
        down_in_cam=torch.tensor(down, dtype=torch.float64),
        down_sigma=torch.full((len(images),), _gravity_sigma(top) if has_gravity else math.inf, dtype=torch.float64),
        height=torch.tensor([height or 1.0 for height in heights], dtype=torch.float64),
        has_height=torch.tensor([height is not None for height in heights]),
        length_unit=top.length_unit(),
        has_gravity=has_gravity,
        heading=torch.tensor([_heading(image) if has_heading else 0.0 for image in images], dtype=torch.float64),
        has_heading=has_heading,
        water_extent=_water_extent(top, images),
    )
    whole = [i for i, path in enumerate(paths) if path not in damaged]
    if len(whole) < 2:
        raise next(iter(damaged.values()))
    if damaged:
        reasons = {name: str(damaged[path]) for name, path in zip(names, paths, strict=True) if path in damaged}
        capture = replace(capture.of_views(whole), damaged=reasons)
    Masks(capture).check()
    return capture


def capture_intrinsics(top: Fields) -> Intrinsics:
    """The intrinsics that capture.json describes."""
    fields = top.object("intrinsics")
    fields.only("width", "height", "fx", "fy", "cx", "cy", "distortion")
    shift = pixel_shift(top, top.text("pixel_origin"))
    distortion = fields.numbers("distortion", 5) if "distortion" in fields else (0.0,) * 5
    return read_intrinsics(fields, distortion, shift)


def read_intrinsics(fields: Fields, distortion: Sequence[float], shift: float = 0.0) -> Intrinsics:
    """Size, focal lengths and principal point, which is moved by `shift` pixels both ways."""
    width, height = fields.integer("width"), fields.integer("height")
    focal, (cx, cy) = ((fields.number(x), fields.number(y)) for x, y in (("fx", "fy"), ("cx", "cy")))
    for name, value in zip(("width", "height", "fx", "fy"), (width, height, *focal), strict=True):
        if value <= 0:
            raise fields.fail(name, f"is {value:g}, but must be above 0")
    intrinsics = Intrinsics.create(width, height, focal, (cx + shift, cy + shift), distortion)
    if (wrong := implausible(intrinsics)) is not None:
        raise fields.fail(*wrong)
    return intrinsics


def intrinsics_content(intrinsics: Intrinsics) -> dict[str, Any]:
    """What `read_intrinsics` reads."""
    numbers = (intrinsics.width, intrinsics.height, *intrinsics.focal.tolist(), *intrinsics.principal_point.tolist())
    named = dict(zip(("width", "height", "fx", "fy", "cx", "cy"), numbers, strict=True))
    return {**named, "distortion": intrinsics.distortion.tolist()}


def pixel_shift(top: Fields, origin: str) -> float:
    """From pixels that are counted from `origin` to those of this package."""
    if origin not in PIXEL_SHIFT:
        raise top.fail("pixel_origin", f"is {origin!r}, but must be 'center' (OpenCV) or 'corner' (COLMAP)")
    return PIXEL_SHIFT[origin]


def read_index_ratio(top: Fields) -> float:
    """The index ratio that capture.json or truth.json states."""
    ratio = top.number("index_ratio")
    if not 1.0 <= ratio <= MAX_INDEX_RATIO:
        raise top.fail("index_ratio", f"is {ratio:g}, but {INDEX_RATIO_RANGE}")
    return ratio


def _names(images: list[Fields]) -> tuple[str, ...]:
    for image in images:
        image.only("name", "down_in_cam", "height", "heading_deg", "center_prior", "water_extent")
        name = image.text("name")
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise image.fail("name", f"is {name!r}, but must name a file inside images/")
    return different_names(images)


def _water_extent(top: Fields, images: list[Fields]) -> WaterExtent | None:
    shift = pixel_shift(top, top.text("pixel_origin"))
    extent = WaterExtent(read_extent(top), tuple(read_extent(image, shift) for image in images))
    return extent if extent.from_above is not None or extent.is_drawn else None


def _gravity_sigma(top: Fields) -> float:
    """In radians."""
    sigma = top.number("down_in_cam_sigma_deg")
    if not 0.0 < sigma <= 30.0:
        raise top.fail("down_in_cam_sigma_deg", f"is {sigma:g}, but must be above 0 and at most 30 degrees")
    return math.radians(sigma)


def _require_for_all(image: Fields, field: str) -> None:
    if field not in image:
        problem = f"of {image.text('name')} is missing, but others have it; give it for all images or for none"
        raise image.fail(field, problem)


def _gravity(image: Fields) -> list[float]:
    _require_for_all(image, "down_in_cam")
    down = image.numbers("down_in_cam", 3)
    norm = sum(x * x for x in down) ** 0.5
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise image.fail("down_in_cam", f"has length {norm:.4f}, but must be a unit vector (within {UNIT_TOLERANCE:g})")
    if down[2] <= 0.0:
        wanted = "with camera z forward its third component must be above 0"
        raise image.fail("down_in_cam", f"is {down}, a camera that looks at the sky; {wanted}")
    return [x / norm for x in down]


def _heading(image: Fields) -> float:
    """In radians."""
    _require_for_all(image, "heading_deg")
    return math.radians(image.number("heading_deg"))


def _height(image: Fields) -> float | None:
    if "center_prior" in image:
        image.position("center_prior")
    if "height" not in image:
        return None
    height = image.number("height")
    if height <= 0.0:
        raise image.fail("height", f"is {height:g}, but a camera stands above the water: above 0")
    if not LEAST_HEIGHT <= height <= MOST_HEIGHT:
        raise image.fail("height", f"is {height:g}, but must lie between {LEAST_HEIGHT:g} and {MOST_HEIGHT:g}")
    return height


def _damaged(paths: Sequence[Path], intrinsics: Intrinsics) -> dict[Path, DamagedPhotographError]:
    """What is wrong with those images that are not whole."""
    damaged = {}
    for path in paths:
        try:
            _check_image(path, intrinsics)
        except DamagedPhotographError as error:
            damaged[path] = error
    return damaged


def _check_image(path: Path, intrinsics: Intrinsics) -> None:
    if not path.is_file():
        raise CaptureError(f"{path} does not exist, but capture.json lists it; add the image or remove its entry")
    check_photograph(path)
    pixels = read_grey(path)
    height, width = pixels.shape
    if (width, height) != (intrinsics.width, intrinsics.height):
        wanted = f"{intrinsics.width}x{intrinsics.height}"
        raise CaptureError(f"{path} is {width}x{height}, but intrinsics.width and height say {wanted}")
