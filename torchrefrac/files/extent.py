"""The extent of water as a polygon in a JSON file."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.files.fields import Fields
from torchrefrac.geometry.polygon import is_simple

EXTENT = "water_extent"
MOST_CORNERS = 10_000  # every pair of sides is looked at


def read_extent(fields: Fields, shift: float = 0.0) -> Float[Tensor, "c 2"] | None:
    """The corners in `water_extent` of an object, moved by `shift` both ways; None where it has none.

    Raises CaptureError for what is no list of corners of two finite numbers, fewer than three of them or more than
    anybody draws, and sides that cross or fold back.
    """
    if EXTENT not in fields:
        return None
    rows = fields.rows(EXTENT, 2)
    if not 3 <= len(rows) <= MOST_CORNERS:
        raise fields.fail(EXTENT, f"has {len(rows)} corners, but a polygon has from 3 to {MOST_CORNERS}")
    corners = torch.tensor(rows, dtype=torch.float64)
    if not is_simple(corners):
        wanted = "give the corners once each, in order along the water's edge"
        raise fields.fail(EXTENT, f"is a polygon whose sides cross or fold back; {wanted}")
    return corners + shift
