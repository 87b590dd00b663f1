"""Where a local frame stands on Earth, as a field of a JSON file."""

from typing import Any

from torchrefrac.files.fields import Fields
from torchrefrac.scene.georeference import LEVEL, Georeference

GEOREFERENCE = "georeference"
MOST_STRETCHED = 10.0  # of any map, as that of Mercator far in the north
STEEPEST = 1.0


def read_georeference(top: Fields, of_water: bool = False) -> Georeference | None:
    """That of a file; None where it has none. of_water: its frame may slope, as that of a finished scene does with the
    water. Raises what reading its fields raises, also where lengths of the file are not in metres, as those of a map
    are."""
    if GEOREFERENCE not in top:
        return None
    if top.length_unit() != "m":
        raise top.fail("length_unit", f"is {top.length_unit()!r}, but must be 'm' where there is a {GEOREFERENCE}")
    fields = top.object(GEOREFERENCE)
    fields.only("crs", "origin", "vertical", "scale", *(("slope",) if of_water else ()))
    east, north, up = fields.position("origin")
    scale = fields.positive("scale", MOST_STRETCHED) if "scale" in fields else 1.0
    slope = fields.numbers("slope", 2) if "slope" in fields else LEVEL
    if max(map(abs, slope)) > STEEPEST:
        raise fields.fail("slope", f"is {slope}, but water rises by {STEEPEST:g} per metre at most")
    vertical = fields.text("vertical", "") or None
    return Georeference(fields.text("crs"), (east, north, up), vertical, scale, (slope[0], slope[1]))


def georeference_content(georeference: Georeference) -> dict[str, Any]:
    """What `read_georeference` reads."""
    content: dict[str, Any] = {"crs": georeference.crs, "origin": list(georeference.origin)}
    if georeference.vertical is not None:
        content["vertical"] = georeference.vertical
    if georeference.scale != 1.0:
        content["scale"] = georeference.scale
    if georeference.slope != LEVEL:
        content["slope"] = list(georeference.slope)
    return content
