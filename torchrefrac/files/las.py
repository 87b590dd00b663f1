"""LAS 1.4 point clouds, compressed as LAZ where the name ends so. Needs laspy with lazrs, of the extra `geo`."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.files.systems import system_of
from torchrefrac.recorder import Advance

MISSING = "a LAS file needs laspy, lazrs and pyproj, which are not all installed: pip install torchrefrac[geo]"
POINT_FORMAT, VERSION = 7, "1.4"  # with colours
FINEST = 1e-4  # of coordinates, length units
MOST_STEPS = 2**31 - 1
TO_16_BIT = 257
Extra = dict[str, tuple[Shaped[Tensor, " n"], str]]
Extent = tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]


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
    extra: Extra = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.coordinates)

    def __getitem__(self, rows: slice) -> "LasPoints":
        """Some of them."""
        extra = {name: (values[rows], what) for name, (values, what) in self.extra.items()}
        return LasPoints(self.coordinates[rows], self.colors[rows], self.classes[rows], extra)


def require_las(crs: str | None = None) -> None:
    """Raise what writing would: ImportError where laspy or lazrs is missing, ValueError where crs is not known."""
    if not all(find_spec(name) for name in ("laspy", "lazrs", "pyproj")):
        raise ImportError(MISSING)
    if crs is not None:
        system_of(crs)


def write_las(
    parts: Iterable[LasPoints],
    path: str | Path,
    extent: Extent,
    crs: str | None = None,
    advance: Advance | None = None,
) -> None:
    """Write points as LAS 1.4, point format 7, with the reference system in the header (WKT).

    parts: points with the same extra values, of which one part after the other is in memory. extent: least and largest
    coordinates of all. Coordinates are whole multiples of 0.1 mm (of a ten-thousandth of any unit) from a whole origin
    near them, or of more where the cloud is so large that this would not fit. Extra bytes are float32. advance: is
    called with the number of points of each part. Raises ImportError where laspy is missing, ValueError where crs is
    not known.
    """
    require_las(crs)
    import laspy  # noqa: PLC0415 - of an extra

    header = laspy.LasHeader(version=VERSION, point_format=POINT_FORMAT)
    header.offsets, header.scales = _grid(extent)
    header.generating_software = "torchrefrac"
    header.system_identifier = "EXTRACTION"
    if crs is not None:
        header.add_crs(system_of(crs))
    parts = iter(parts)
    first = next(parts, None)
    if first is not None and first.extra:
        header.add_extra_dims(
            [laspy.ExtraBytesParams(name, "f4", description=what) for name, (_, what) in first.extra.items()]
        )
    with replacing(Path(path)) as temporary, laspy.open(temporary, mode="w", header=header) as file:
        for points in chain(() if first is None else (first,), parts):
            file.write_points(_record(points, header))
            if advance is not None:
                advance(len(points), "")


def _record(points: LasPoints, header: Any) -> Any:
    import laspy  # noqa: PLC0415

    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = points.coordinates.double().cpu().numpy().T
    colors = points.colors.cpu().numpy().astype(np.uint16) * TO_16_BIT
    record.red, record.green, record.blue = colors.T
    record.classification = points.classes.cpu().numpy().astype(np.uint8)
    ones = np.ones(len(points), dtype=np.uint8)
    record.return_number, record.number_of_returns = ones, ones
    for name, (values, _) in points.extra.items():
        record[name] = values.float().cpu().numpy()
    return record


def extent_of(parts: Iterable[Float[Tensor, "_ 3"]]) -> Extent:
    """Least and largest coordinates of points in several parts; zero where there are none."""
    low, high = torch.full((3,), torch.inf, dtype=torch.float64), torch.full((3,), -torch.inf, dtype=torch.float64)
    for points in parts:
        if len(points):
            low, high = torch.minimum(low, points.amin(dim=0)), torch.maximum(high, points.amax(dim=0))
    return (low, high) if bool(low.isfinite().all()) else (torch.zeros_like(low), torch.zeros_like(high))


def _grid(extent: Extent) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Origin and step of the whole numbers that coordinates are written as."""
    low, high = (end.cpu().numpy() for end in extent)
    offset = np.floor(low)
    needed = np.maximum((high - offset) / (MOST_STEPS * FINEST), 1.0)
    return offset, FINEST * 10.0 ** np.ceil(np.log10(needed))
