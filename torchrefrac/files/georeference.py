"""Where a local frame stands on Earth, as a field of a JSON file."""

from typing import Any

from torchrefrac.files.fields import Fields
from torchrefrac.scene.georeference import Georeference

GEOREFERENCE = "georeference"
MOST_STRETCHED = 10.0  # of any map, as that of Mercator far in the north


def read_georeference(top: Fields) -> Georeference | None:
    """That of a file; None where it has none. Raises what reading its fields raises, also where lengths of the file are
    not in metres, as those of a map are."""
    if GEOREFERENCE not in top:
        return None
    if top.length_unit() != "m":
        raise top.fail("length_unit", f"is {top.length_unit()!r}, but must be 'm' where there is a {GEOREFERENCE}")
    fields = top.object(GEOREFERENCE)
    fields.only("crs", "origin", "vertical", "scale")
    east, north, up = fields.position("origin")
    scale = fields.positive("scale", MOST_STRETCHED) if "scale" in fields else 1.0
    return Georeference(fields.text("crs"), (east, north, up), fields.text("vertical", "") or None, scale)


def georeference_content(georeference: Georeference) -> dict[str, Any]:
    """What `read_georeference` reads."""
    content: dict[str, Any] = {"crs": georeference.crs, "origin": list(georeference.origin)}
    if georeference.vertical is not None:
        content["vertical"] = georeference.vertical
    if georeference.scale != 1.0:
        content["scale"] = georeference.scale
    return content
