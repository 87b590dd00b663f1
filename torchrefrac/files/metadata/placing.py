"""Positions of photographs in one frame: that of a map's grid, or of a table's own coordinates."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from torchrefrac.files.metadata.local_frame import REMEDY, Grid, has_projections, origin_of, zone_of
from torchrefrac.files.metadata.position import Vertical

PREFERRED = (Vertical.TABLE, Vertical.ELLIPSOID, Vertical.SEA_LEVEL, Vertical.TAKE_OFF)
NO_GRID = "its position is in degrees, those of others in a frame of their own; give crs, such as EPSG:32633"


@dataclass(frozen=True)
class Place:
    """Where a photograph is stated to have been taken: in degrees (latitude, longitude) or as a point (east, north); m.
    sigma: horizontal and vertical."""

    degrees: tuple[float, float] | None
    point: tuple[float, float] | None
    altitudes: Mapping[Vertical, float]
    sigma: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Placement:
    """Positions from `origin` where `known`, with standard deviations, in m on the ground; north_deg: what is added to
    a true heading for one from the grid's north. crs: None for a frame of its own. scale: how long a metre on the
    ground is in the plane of its map. vertical: what altitudes are counted from. lacking: why photographs have none, by
    their numbers."""

    position: Float[np.ndarray, "m 3"]
    known: Bool[np.ndarray, " m"]
    sigma: Float[np.ndarray, "m 3"]
    north_deg: Float[np.ndarray, " m"]
    crs: str | None
    origin: tuple[float, float, float]
    vertical: Vertical | None
    lacking: Mapping[int, str]
    scale: float = 1.0


def place_all(places: Sequence[Place | None], crs: str | None, wanted: Vertical | None) -> Placement:
    """The photographs in one frame, `crs` or by default their zone of UTM, with altitudes counted from one level: the
    one that is wanted, or that of most."""
    count = len(places)
    lacking = {i: "no position" for i, place in enumerate(places) if place is None}
    vertical = wanted or _commonest(places)
    for i, place in enumerate(places):
        if place is not None and vertical not in place.altitudes:
            lacking[i] = _why_without(place, vertical)
    some = {i: place for i, place in enumerate(places) if place is not None and i not in lacking}
    degrees = [i for i, place in some.items() if place.point is None]
    points = [i for i in some if i not in degrees]
    grid = _grid(crs, [some[i].degrees or (0.0, 0.0) for i in degrees] if not points else [])
    if grid is None and degrees:
        lacking |= dict.fromkeys(degrees, f"pyproj is missing: {REMEDY}" if not has_projections() else NO_GRID)
        degrees = []
    position, north = np.zeros((count, 3)), np.zeros(count)
    if points:
        position[points, :2] = [some[i].point or (0.0, 0.0) for i in points]
        north[points] = 0.0 if grid is None else grid.degrees(position[points, :2])[2]
    if degrees and grid is not None:
        latitude, longitude = zip(*(some[i].degrees or (0.0, 0.0) for i in degrees), strict=True)
        position[degrees, :2], north[degrees] = grid.place(latitude, longitude)
    placed, known = sorted((*degrees, *points)), np.zeros(count, dtype=bool)
    known[placed] = True
    if vertical is not None:
        position[known, 2] = [some[i].altitudes[vertical] for i in placed]
    sigma = np.ones((count, 3))
    for i in placed:
        sigma[i] = some[i].sigma[0], some[i].sigma[0], some[i].sigma[1]
    north[~known] = north[known].mean() if known.any() else 0.0
    origin = origin_of(position[known]) if known.any() and grid is not None else (0.0, 0.0, 0.0)
    scale = grid.scale_at(origin, float(np.median(position[known, 2]))) if known.any() and grid is not None else 1.0
    position[known] -= origin
    position[known, :2] /= scale
    return Placement(
        position, known, sigma, north, grid.crs if grid and known.any() else None, origin,
        vertical, lacking, scale,
    )  # fmt: skip


def _grid(crs: str | None, degrees: Sequence[tuple[float, float]]) -> Grid | None:
    if not has_projections() or (crs is None and not degrees):
        return None
    return Grid(crs if crs is not None else zone_of(*zip(*degrees, strict=True)))


def _commonest(places: Sequence[Place | None]) -> Vertical | None:
    """The level that altitudes of most are counted from; that of the take-off only where there is no other."""
    counts = Counter(level for place in places if place is not None for level in place.altitudes)
    others = [level for level in PREFERRED if counts[level] and level is not Vertical.TAKE_OFF]
    if not others:
        return Vertical.TAKE_OFF if counts else None
    return max(others, key=lambda level: counts[level])


def _why_without(place: Place, vertical: Vertical | None) -> str:
    if not place.altitudes or vertical is None:
        return "a position without an altitude"
    found = " and ".join(place.altitudes)
    return f"its altitude is counted from the {found}, those of others from the {vertical}; vertical=take_off may do"
