"""`capture.json`, format 2, of photographs and what is known of them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchrefrac.files.capture import SEVERAL as FORMAT
from torchrefrac.files.georeference import GEOREFERENCE, georeference_content
from torchrefrac.files.metadata.gathered import Gathered
from torchrefrac.files.metadata.lens import DIGITS, Lens
from torchrefrac.files.metadata.placing import Placement
from torchrefrac.files.metadata.position import Vertical
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.georeference import Georeference

BAROMETER_SIGMA = 0.5  # m; of a height above the place of the take-off, with the drift of a flight


@dataclass(frozen=True)
class Water:
    """The water's altitude, or the height of the place of the take-off above it, in m, where one is known;
    and the epoch of each photograph, where the water stood differently."""

    index_ratio: float
    level: float | None = None
    take_off_above: float | None = None
    epochs: Sequence[str] = ()


def capture_content(
    folder: str, gathered: Sequence[Gathered], lenses: Mapping[str, Lens], placement: Placement, water: Water
) -> dict[str, Any]:
    """What is written. Raises CaptureError where a camera would stand below the water."""
    sigmas = [one.attitude.sigma_deg for one in gathered if one.attitude is not None and not one.looks_up]
    spreads = [tuple(row) for row, known in zip(placement.sigma.tolist(), placement.known, strict=True) if known]
    gravity_sigma, position_sigma = _commonest(sigmas), _commonest(spreads)
    content: dict[str, Any] = {"format": FORMAT, "length_unit": "m", "pixel_origin": "corner", "folder": folder}
    content["index_ratio"] = water.index_ratio
    content["cameras"] = {
        name: lens.content(next(one.photograph.size for one in gathered if one.camera == name))
        for name, lens in lenses.items()
    }
    if gravity_sigma is not None:
        content["down_in_cam_sigma_deg"] = gravity_sigma
    if position_sigma is not None:
        content["position_sigma"] = [_rounded(sigma) for sigma in position_sigma]
    if placement.crs is not None:
        vertical = None if placement.vertical in (None, Vertical.TABLE) else str(placement.vertical)
        place = Georeference(placement.crs, placement.origin, vertical, placement.scale)
        content[GEOREFERENCE] = georeference_content(place)
    images: list[dict[str, Any]] = []
    for i, one in enumerate(gathered):
        image: dict[str, Any] = {"name": one.name, "camera": one.camera}
        if one.attitude is not None and not one.looks_up:
            image["down_in_cam"] = [_rounded(part) for part in one.attitude.down_in_cam]
            if one.attitude.sigma_deg != gravity_sigma:
                image["down_in_cam_sigma_deg"] = one.attitude.sigma_deg
            if one.attitude.heading_deg is not None:
                image["heading_deg"] = _rounded((one.attitude.heading_deg + placement.north_deg[i]) % 360.0)
        if water.epochs:
            image["epoch"] = water.epochs[i]
        height, height_sigma = _height(one, placement.vertical, water)
        if height is not None:
            image["height"] = _rounded(height)
        if height_sigma is not None:
            image["height_sigma"] = _rounded(height_sigma)
        if placement.known[i]:
            image["position"] = [_rounded(coordinate) for coordinate in placement.position[i].tolist()]
            if tuple(placement.sigma[i].tolist()) != position_sigma:
                image["position_sigma"] = [_rounded(sigma) for sigma in placement.sigma[i].tolist()]
        images.append(image)
    return content | {"images": images}


def _height(one: Gathered, vertical: Vertical | None, water: Water) -> tuple[float | None, float | None]:
    """Above the water, in m: as the table states it, or from an altitude where the user knows the water's; and its
    standard deviation, None where that is the usual share of it."""
    if one.height is not None or one.place is None:
        return one.height, None
    altitudes, (_, sigma) = one.place.altitudes, one.place.sigma
    if water.level is not None and vertical is not None and vertical in altitudes:
        height = altitudes[vertical] - water.level
    elif water.take_off_above is not None and Vertical.TAKE_OFF in altitudes:
        height, sigma = altitudes[Vertical.TAKE_OFF] + water.take_off_above, BAROMETER_SIGMA
    else:
        return None, None
    if height <= 0.0:
        option = "take_off_above_water" if water.level is None else "water_level"
        raise CaptureError(
            f"{one.name} would be {height:.2f} m above the water by {option}; give it in the datum of the photographs, "
            f"in which its altitude is counted from the {vertical or 'take-off'}"
        )
    return height, sigma


def _commonest(values: Sequence[Any]) -> Any:
    """None where there are none."""
    return Counter(values).most_common(1)[0][0] if values else None


def _rounded(number: float) -> float:
    return round(number, DIGITS) + 0.0
