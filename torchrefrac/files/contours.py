"""Lines of equal depth as GeoJSON (RFC 7946)."""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrefrac.atomic import replacing
from torchrefrac.scene.raster import Raster

DEGREES = 9  # digits of a degree: a tenth of a millimetre
LENGTHS = 4
MOST_LINES = 1000


def write_contours(raster: Raster, path: str | Path, interval: float, crs: str | None = None) -> int:
    """Write the contours of the depth of a raster at multiples of an interval in its length unit, and how many there
    are. Each is a line with the property `depth`, below 0 on land.

    crs: that of the raster's x and y; lines are then in degrees of WGS 84, as the standard wants, and without it in x
    and y as they are. Raises ValueError where the interval would make over 1000 levels.
    """
    features = [
        {
            "type": "Feature",
            "properties": {"depth": round(level, LENGTHS)},
            "geometry": {"type": "LineString", "coordinates": line},
        }
        for level, lines in _lines(raster, interval)
        for line in _placed(lines, crs)
    ]
    content: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    path = Path(path)
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8")
    return len(features)


def _lines(raster: Raster, interval: float) -> Iterator[tuple[float, Sequence[Any]]]:
    """Each level, and its lines as arrays of points."""
    from contourpy import contour_generator  # noqa: PLC0415 - slow to import

    if min(raster.height.shape) < 2 or not bool(raster.valid.any()):
        return
    depth = raster.depth.cpu().numpy()
    masked = np.ma.masked_array(depth, mask=~raster.valid.cpu().numpy())
    low, high = math.ceil(masked.min() / interval), math.floor(masked.max() / interval)
    if high - low >= MOST_LINES:
        raise ValueError(
            f"contours is {interval:g}, which makes {high - low + 1} levels of depths from {masked.min():g} to "
            f"{masked.max():g} {raster.length_unit}; give a larger interval"
        )
    generator = contour_generator(raster.x.cpu().numpy(), raster.y.cpu().numpy(), masked)
    for step in range(low, high + 1):
        yield step * interval, list(generator.lines(step * interval))


def _placed(lines: Sequence[Any], crs: str | None) -> Iterator[list[list[float]]]:
    if crs is None:
        yield from ([[round(x, LENGTHS), round(y, LENGTHS)] for x, y in line.tolist()] for line in lines)
        return
    from pyproj import Transformer  # noqa: PLC0415 - of an extra

    to_degrees = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    for line in lines:
        longitude, latitude = to_degrees.transform(*line.T)
        points = zip(longitude.tolist(), latitude.tolist(), strict=True)
        yield [[round(x, DEGREES), round(y, DEGREES)] for x, y in points]
