"""Positions of a capture: from latitude and longitude into a map's grid, and from there to an origin near by."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float

from torchrefrac.files.systems import horizontal_part, system_of
from torchrefrac.scene.capture import CaptureError

WGS84 = "EPSG:4326"
STEP = 1e-4  # degrees to the north, 11 m, along which the grid's north is compared with the true one
RADIUS = 6_371_000.0  # m, of the Earth; that the ellipsoid is flat matters little for a factor
REMEDY = "install torchrefrac[geo], or do without positions"


def has_projections() -> bool:
    """Whether pyproj is there."""
    return find_spec("pyproj") is not None


def zone_of(latitude: Sequence[float], longitude: Sequence[float]) -> str:
    """The zone of UTM around the middle of some places, as EPSG:32633; south of the equator 327."""
    angle = np.radians(np.asarray(longitude))
    middle = float(np.degrees(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())))
    zone = int((middle + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{326 if np.mean(latitude) >= 0.0 else 327}{zone:02d}"


@dataclass(frozen=True)
class Grid:
    """A projected reference system with axes in m, such as EPSG:32633."""

    crs: str

    def __post_init__(self) -> None:
        """Raises CaptureError where pyproj does not know it, or it has other axes."""
        try:
            plane = self._plane
        except ValueError:
            problem = "is not known to pyproj; give a code such as EPSG:32633, or none for the zone of UTM"
            raise CaptureError(f"crs {self.crs!r} {problem}") from None
        if not plane.is_projected or any(axis.unit_conversion_factor != 1.0 for axis in plane.axis_info):
            problem = "has no axes in metres; give a projected system, such as the zone of UTM"
            raise CaptureError(f"crs {self.crs!r} {problem}")

    @cached_property
    def _plane(self) -> Any:
        return horizontal_part(system_of(self.crs))

    @cached_property
    def _from_degrees(self) -> Any:
        from pyproj import Transformer  # noqa: PLC0415

        return Transformer.from_crs(WGS84, self.crs, always_xy=True)

    def place(
        self, latitude: Sequence[float], longitude: Sequence[float]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """East and north in m of places in degrees, and the bearing of true north there, in degrees clockwise from the
        grid's: what is added to a true heading."""
        here, beyond = (self._transform(np.asarray(latitude) + step, longitude) for step in (0.0, STEP))
        east, north = (beyond - here).T
        return here, np.degrees(np.arctan2(east, north))

    def degrees(self, point: Float[np.ndarray, "n 2"]) -> tuple[list[float], list[float], Float[np.ndarray, " n"]]:
        """Latitude and longitude of points (east, north), and the same bearing there."""
        longitude, latitude = (part.tolist() for part in self._from_degrees.transform(*point.T, direction="INVERSE"))
        return latitude, longitude, self.place(latitude, longitude)[1]

    def scale_at(self, point: Sequence[float], height: float) -> float:
        """How long a metre on the ground is in the plane of the map, at a point (east, north) and a height in m. It is
        0.9996 along the middle of a zone of UTM, and on a mountain of 1000 m less by 0.00016: a flight of 1 km is
        stated 40 cm too short, while its heights are not."""
        from pyproj import Proj  # noqa: PLC0415

        longitude, latitude = self._from_degrees.transform(*point[:2], direction="INVERSE")
        factors = Proj(self._plane).get_factors(longitude, latitude)
        return float(np.sqrt(factors.areal_scale)) * RADIUS / (RADIUS + height)

    def _transform(self, latitude: Float[np.ndarray, " n"], longitude: Sequence[float]) -> Float[np.ndarray, "n 2"]:
        east, north = self._from_degrees.transform(np.asarray(longitude, dtype=float), latitude)
        placed = np.stack((east, north), axis=-1)
        if not np.isfinite(placed).all():
            raise CaptureError(f"crs {self.crs!r} does not reach as far as the photographs; give that of their country")
        return placed


def origin_of(position: Float[np.ndarray, "n 3"]) -> tuple[float, float, float]:
    """Whole metres near the middle of positions; 0 for heights, which are not large."""
    east, north = np.floor(np.median(position[:, :2], axis=0) + 0.5).tolist()
    return float(east), float(north), 0.0
