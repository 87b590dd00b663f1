"""What the images say against something that was stated: warnings that programs and people can read."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any


class WarningCode(StrEnum):
    """What was found, as the `code` of a warning in metrics.json."""

    GRAVITY_CONTRADICTS = "gravity_contradicts"
    GRAVITY_UNDETERMINED = "gravity_undetermined"
    HEIGHT_CONTRADICTS = "height_contradicts"
    POSITION_CONTRADICTS = "position_contradicts"
    CONTROL_CONTRADICTS = "control_contradicts"
    NOT_CONVERGED = "not_converged"
    WEAK_IMAGE = "weak_image"
    INTRINSICS_CONTRADICT = "intrinsics_contradict"
    INDEX_CONTRADICTS = "index_contradicts"
    DAMAGED_IMAGE = "damaged_image"
    DUPLICATE_IMAGE = "duplicate_image"
    CAMERA_NOT_PLACED = "camera_not_placed"
    SEVERAL_RECONSTRUCTIONS = "several_reconstructions"
    WATER_LEVEL_CONTRADICTS = "water_level_contradicts"
    NO_REFRACTION_SEEN = "no_refraction_seen"
    SURFACE_NOT_FLAT = "surface_not_flat"
    POINTS_OUTSIDE_WATER = "points_outside_water"
    REFRACTION_UNMODELLED = "refraction_unmodelled"


@dataclass(frozen=True)
class Finding:
    """A sentence about what was found, and the images that it is about: none where it is about all."""

    code: WarningCode
    message: str
    images: tuple[str, ...] = ()

    @property
    def content(self) -> dict[str, Any]:
        """As it stands in metrics.json."""
        return {"code": str(self.code), "message": self.message, "images": list(self.images)}
