"""Where photographs were taken from, whatever program found it out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.geometry import triples
from torchrefrac.scene.tables import Cameras

EDGE = 33  # points along each side of an image whose distortion is undone


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Photographs as far as one must know them to say which of them show a point.

    center: in the frame of what they show. rotation: `cam_from_world`; None: not known. field: least and largest x/z
    and y/z of what an image shows, as (left, right, top, bottom), infinite where its calibration is not known; None: of
    no image. crs: the reference system of the centres, where it is known.
    """

    names: tuple[str, ...]
    center: Float[Tensor, "m 3"]
    rotation: Float[Tensor, "m 3 3"] | None = None
    field: Float[Tensor, "m 4"] | None = None
    crs: str | None = None

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, rows: Shaped[Tensor, " k"]) -> "Viewpoints":
        """Some of them, by a mask or by their numbers."""
        chosen = torch.arange(len(self))[rows].tolist()
        rotation, field = (None if values is None else values[rows] for values in (self.rotation, self.field))
        names = tuple(self.names[i] for i in chosen)
        return replace(self, names=names, center=self.center[rows], rotation=rotation, field=field)

    def see(self, offsets: Float[Tensor, "n m 3"]) -> Bool[Tensor, "n m"]:
        """Which photographs show points at these offsets from their centres, seen straight: those into whose field they
        fall; all of them where nobody knows which way they look."""
        if self.rotation is None:
            return torch.ones_like(offsets[..., 0], dtype=torch.bool)
        x, y, z = triples.rotated(triples.rows(self.rotation), triples.split(offsets))
        ahead = z > 0.0
        if self.field is None:
            return ahead
        left, right, top, bottom = triples.components(self.field)
        return ahead & (x >= left * z) & (x <= right * z) & (y >= top * z) & (y <= bottom * z)


def field_of_view(cameras: Cameras, camera: Int[Tensor, " m"]) -> Float[Tensor, "m 4"]:
    """`Viewpoints.field` of photographs with these rows of a table of cameras: the upright rectangle around the edge of
    an image once its distortion is undone."""
    rows = [_field(cameras, row) for row in range(len(cameras))]
    return torch.stack(rows)[camera]


def _field(cameras: Cameras, row: int) -> Float[Tensor, " 4"]:
    lens = cameras[row]
    along = torch.linspace(0.0, 1.0, EDGE, dtype=torch.float64)
    zero, one = torch.zeros_like(along), torch.ones_like(along)
    sides: Sequence[tuple[Tensor, Tensor]] = ((along, zero), (along, one), (zero, along), (one, along))
    edge = torch.cat([torch.stack(side, dim=-1) for side in sides]) * along.new_tensor((lens.width, lens.height))
    low, high = torch.aminmax(lens.plane_from_pixels(edge), dim=0)
    return torch.stack((low, high), dim=-1).flatten()
