"""LAS 1.4 point clouds, compressed as LAZ where the name ends so. Needs laspy with lazrs, of the extra `geo`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.recorder import Advance

MISSING = "a LAS file needs laspy, lazrs and pyproj, which are not all installed: pip install torchrefrac[geo]"
POINT_FORMAT, VERSION = 7, "1.4"  # with colours
FINEST = 1e-4  # of coordinates, length units
MOST_STEPS = 2**31 - 1
CHUNK = 1_000_000  # points that are written at once
TO_16_BIT = 257


class PointClass(IntEnum):
    """Of the standard's classes (ASPRS, LAS 1.4, and its topo-bathymetric domain) those that are used here."""

    UNCLASSIFIED = 1
    GROUND = 2
    WATER_SURFACE = 9
    BATHYMETRIC = 40


@dataclass(frozen=True)
class LasPoints:
    """Points as they are written: coordinates in the reference system of the file, RGB, class and return values.

    extra: numbers of each point by name, which viewers show as scalar fields, and what each is, at most 32 characters.
    """

    coordinates: Float[Tensor, "n 3"]
    colors: UInt8[Tensor, "n 3"]
    classes: Int[Tensor, " n"]
    extra: Mapping[str, tuple[Shaped[Tensor, " n"], str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.coordinates)


def require_las(crs: str | None = None) -> None:
    """Raise what writing would: ImportError where laspy or lazrs is missing, ValueError where crs is not known."""
    if not all(find_spec(name) for name in ("laspy", "lazrs", "pyproj")):
        raise ImportError(MISSING)
    if crs is not None:
        _system(crs)


def write_las(points: LasPoints, path: str | Path, crs: str | None = None, advance: Advance | None = None) -> None:
    """Write points as LAS 1.4, point format 7, with the reference system in the header (WKT).

    Coordinates are whole multiples of 0.1 mm (of a ten-thousandth of any unit) from a whole origin near them, or of
    more where the cloud is so large that this would not fit. Extra bytes are float32. advance: is called with the
    number of points of each chunk. Raises ImportError where laspy is missing, ValueError where crs is not known.
    """
    require_las(crs)
    import laspy  # noqa: PLC0415 - of an extra

    header = laspy.LasHeader(version=VERSION, point_format=POINT_FORMAT)
    header.offsets, header.scales = _grid(points.coordinates)
    header.generating_software = "torchrefrac"
    header.system_identifier = "EXTRACTION"
    if points.extra:
        header.add_extra_dims(
            [laspy.ExtraBytesParams(name, "f4", description=what) for name, (_, what) in points.extra.items()]
        )
    if crs is not None:
        header.add_crs(_system(crs))
    path = Path(path)
    with replacing(path) as temporary, laspy.open(temporary, mode="w", header=header) as file:
        for start in range(0, len(points), CHUNK):
            rows = slice(start, start + CHUNK)
            file.write_points(_record(points, rows, header))
            if advance is not None:
                advance(min(CHUNK, len(points) - start), "")


def _record(points: LasPoints, rows: slice, header: Any) -> Any:
    import laspy  # noqa: PLC0415

    coordinates = points.coordinates[rows].double().cpu().numpy()
    record = laspy.ScaleAwarePointRecord.zeros(len(coordinates), header=header)
    record.x, record.y, record.z = coordinates.T
    colors = points.colors[rows].cpu().numpy().astype(np.uint16) * TO_16_BIT
    record.red, record.green, record.blue = colors.T
    record.classification = points.classes[rows].cpu().numpy().astype(np.uint8)
    ones = np.ones(len(coordinates), dtype=np.uint8)
    record.return_number, record.number_of_returns = ones, ones
    for name, (values, _) in points.extra.items():
        record[name] = values[rows].float().cpu().numpy()
    return record


def _grid(coordinates: Float[Tensor, "n 3"]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Origin and step of the whole numbers that coordinates are written as."""
    if not len(coordinates):
        return np.zeros(3), np.full(3, FINEST)
    low, high = coordinates.amin(dim=0).cpu().numpy(), coordinates.amax(dim=0).cpu().numpy()
    offset = np.floor(low)
    needed = np.maximum((high - offset) / (MOST_STEPS * FINEST), 1.0)
    return offset, FINEST * 10.0 ** np.ceil(np.log10(needed))


def _system(crs: str) -> Any:
    from pyproj import CRS  # noqa: PLC0415 - of an extra
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        return CRS.from_user_input(crs)
    except CRSError as error:
        raise ValueError(f"crs is {crs!r}, which is no coordinate reference system: {error}") from None
