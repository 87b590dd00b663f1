"""What capture.json says was measured with each image: gravity, height above the water, position, heading."""

import math
from collections.abc import Sequence
from typing import Any

import torch

from torchrefrac.files.fields import FARTHEST, Fields
from torchrefrac.scene.capture import RELATIVE_HEIGHT_SIGMA

UNIT_TOLERANCE = 1e-3
OPTICAL_AXIS, OPPOSITE = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]
LEAST_HEIGHT, MOST_HEIGHT = 1e-9, 1e9  # in any unit; the sixth powers that covariances need have an exponent
MOST_SIGMA_DEG = 30.0
UNKNOWN = [math.inf] * 3
FIELDS = (
    "down_in_cam", "down_in_cam_sigma_deg", "normal_in_cam", "normal_sigma_deg", "height", "height_sigma", "position",
    "position_sigma", "heading_deg",
)  # fmt: skip


def read_measured(top: Fields, images: Sequence[Fields], may_be_level: bool = False) -> dict[str, Any]:
    """The fields of a `Capture` that hold it. A sigma that an image does not state is that of all. may_be_level: the
    interface is no water below the cameras, which need not look down then."""
    down = [_gravity(image, may_be_level) for image in images]
    normal = [_normal(image) for image in images]
    heights = [_height(image) for image in images]
    numbers = {
        "down_in_cam": [OPTICAL_AXIS if one is None else one for one in down],
        "down_sigma": [math.inf if "down_in_cam" not in image else _down_sigma(top, image) for image in images],
        "normal_in_cam": [OPPOSITE if one is None else one for one in normal],
        "normal_sigma": [
            math.inf if one is None else _normal_sigma(top, i) for i, one in zip(images, normal, strict=True)
        ],
        "height": [height or 1.0 for height in heights],
        "height_sigma": [_height_sigma(top, *each) for each in zip(images, heights, strict=True)],
        "position": [image.position("position") if "position" in image else [0.0] * 3 for image in images],
        "position_sigma": [_position_sigma(top, image) for image in images],
        "heading": [math.radians(image.number("heading_deg")) if "heading_deg" in image else 0.0 for image in images],
    }
    return {
        **{name: torch.tensor(values, dtype=torch.float64) for name, values in numbers.items()},
        "has_gravity": any(one is not None for one in down),
        "has_height": torch.tensor([height is not None for height in heights]),
        "has_heading": torch.tensor(["heading_deg" in image for image in images]),
    }


def require_for_all(images: Sequence[Fields], *names: str) -> None:
    """Refuse what only some of the images have."""
    for name in names:
        missing = [image for image in images if name not in image]
        if len(missing) in (0, len(images)):
            continue
        problem = f"of {missing[0].text('name')} is missing, but others have it; give it for all images or for none"
        raise missing[0].fail(name, problem)


def _gravity(image: Fields, may_be_level: bool) -> list[float] | None:
    down = _unit(image, "down_in_cam")
    if down is not None and down[2] <= 0.0 and not may_be_level:
        wanted = "with camera z forward its third component must be above 0"
        raise image.fail("down_in_cam", f"is {down}, a camera that looks at the sky; {wanted}")
    return down


def _normal(image: Fields) -> list[float] | None:
    """Of the wall that an image looks through."""
    normal = _unit(image, "normal_in_cam")
    if normal is not None and normal[2] >= 0.0:
        raise image.fail(
            "normal_in_cam", f"is {normal}, but must point towards the camera: its third component below 0"
        )
    return normal


def _unit(image: Fields, name: str) -> list[float] | None:
    if name not in image:
        return None
    vector = image.numbers(name, 3)
    norm = sum(x * x for x in vector) ** 0.5
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise image.fail(name, f"has length {norm:.4f}, but must be a unit vector (within {UNIT_TOLERANCE:g})")
    return [x / norm for x in vector]


def _down_sigma(top: Fields, image: Fields) -> float:
    return _angle(top, image, "down_in_cam_sigma_deg")


def _normal_sigma(top: Fields, image: Fields) -> float:
    return _angle(top, image, "normal_sigma_deg")


def _angle(top: Fields, image: Fields, name: str) -> float:
    """In radians."""
    fields = _own_or_common(top, image, name)
    sigma = fields.number(name)
    if not 0.0 < sigma <= MOST_SIGMA_DEG:
        raise fields.fail(name, f"is {sigma:g}, but must be above 0 and at most {MOST_SIGMA_DEG:g} degrees")
    return math.radians(sigma)


def _height(image: Fields) -> float | None:
    if "height" not in image:
        return None
    height = image.number("height")
    if height <= 0.0:
        raise image.fail("height", f"is {height:g}, but a camera stands above the water: above 0")
    if not LEAST_HEIGHT <= height <= MOST_HEIGHT:
        raise image.fail("height", f"is {height:g}, but must lie between {LEAST_HEIGHT:g} and {MOST_HEIGHT:g}")
    return height


def _height_sigma(top: Fields, image: Fields, height: float | None) -> float:
    if height is None:
        return math.inf
    fields = _own_or_common(top, image, "height_sigma")
    return fields.positive("height_sigma", MOST_HEIGHT) if "height_sigma" in fields else RELATIVE_HEIGHT_SIGMA * height


def _position_sigma(top: Fields, image: Fields) -> list[float]:
    if "position" not in image:
        return UNKNOWN
    return _own_or_common(top, image, "position_sigma").positives("position_sigma", 3, FARTHEST)


def _own_or_common(top: Fields, image: Fields, name: str) -> Fields:
    """Where a sigma stands."""
    return image if name in image else top
