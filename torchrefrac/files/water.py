"""`water.json`: where the water surface lies in the frame of an alignment, and how strongly it refracts."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import torch
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.files.capture import MAX_INDEX_RATIO
from torchrefrac.files.fields import Fields, alignment_errors, read_object
from torchrefrac.scene.alignment import AlignmentError

FORMAT = "torchrefrac-water/1"


@dataclass(frozen=True, eq=False)
class Water:
    """E water surfaces, each the plane normal . x = offset: normal (E, 3) unit vectors that point up, offset (E) in
    length_unit; the frame is that of the alignment.

    index_ratio is n_water / n_air. plane_of: the surface that each image looks through, by the name of the image; where
    there is one surface every image does, listed or not.

    Raises AlignmentError where E is 0, shapes differ, a normal is no unit vector, plane_of names a surface that is not
    there, or the index ratio lies below 1 or beyond any liquid.
    """

    index_ratio: float
    normal: Tensor
    offset: Tensor
    plane_of: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    length_unit: str = "unit"

    def __post_init__(self) -> None:
        if not 1.0 <= self.index_ratio <= MAX_INDEX_RATIO:
            raise AlignmentError(
                f"index_ratio is {self.index_ratio:g}, but n_water / n_air lies between 1 and {MAX_INDEX_RATIO:g} "
                "(water: 1.333)"
            )
        count = len(self.offset)
        if count == 0 or self.normal.shape != (count, 3) or self.offset.shape != (count,):
            raise AlignmentError(
                f"normal and offset have shapes {tuple(self.normal.shape)} and {tuple(self.offset.shape)}, but must "
                "have (E, 3) and (E,) with at least one plane"
            )
        if not (self.normal.norm(dim=-1) - 1.0).abs().max() < 1e-6 or not self.offset.isfinite().all():
            raise AlignmentError("normal must hold unit vectors, and offset finite numbers")
        for name, plane in self.plane_of.items():
            if not 0 <= plane < count:
                raise AlignmentError(
                    f"plane_of[{name!r}] is {plane}, but must lie in 0 to {count - 1}, one of the planes"
                )

    def planes_of(self, names: Sequence[str]) -> Tensor:
        """Which plane (m) long each image looks through; AlignmentError where plane_of does not say it."""
        if len(self.offset) == 1:
            return torch.zeros(len(names), dtype=torch.long, device=self.offset.device)
        missing = [name for name in names if name not in self.plane_of]
        if missing:
            raise AlignmentError(
                f"plane_of lacks {len(missing)} of {len(names)} images, {missing[0]} first; with {len(self.offset)} "
                "planes it must say for each image which it looks through"
            )
        return torch.tensor([self.plane_of[name] for name in names], dtype=torch.long, device=self.offset.device)


def read_water(path: str | Path) -> Water:
    """Read `water.json`. A normal of any length but zero defines its plane by normal . x = offset: both are scaled by
    the length. Raises AlignmentError with the file and the field."""
    path = Path(path)
    with alignment_errors():
        content, top = read_object(path)
        top.only("format", "length_unit", "index_ratio", "planes", "plane_of")
        if top.text("format") != FORMAT:
            raise top.fail("format", f"is {top.text('format')!r}, but must be {FORMAT!r}")
        unit, index_ratio = top.text("length_unit"), top.number("index_ratio")
        planes = [_plane(fields) for fields in top.objects("planes")]
        if not planes:
            raise top.fail("planes", "is empty, but must list at least one plane")
        plane_of: dict[str, int] = {}
        if "plane_of" in top:
            indices = top.object("plane_of")
            plane_of = {name: indices.integer(name) for name in content["plane_of"]}
        elif len(planes) > 1:
            raise top.fail(
                "plane_of", f"is missing, but with {len(planes)} planes it must say which an image looks through"
            )
    try:
        return Water(
            index_ratio=index_ratio,
            normal=torch.tensor([normal for normal, _ in planes], dtype=torch.float64),
            offset=torch.tensor([offset for _, offset in planes], dtype=torch.float64),
            plane_of=MappingProxyType(plane_of),
            length_unit=unit,
        )
    except AlignmentError as error:
        raise AlignmentError(f"{path}: {error}") from None


def write_water(water: Water, path: str | Path) -> None:
    """Write `water.json`."""
    content: dict[str, object] = {
        "format": FORMAT,
        "length_unit": water.length_unit,
        "index_ratio": water.index_ratio,
        "planes": [
            {"normal": normal, "offset": offset}
            for normal, offset in zip(water.normal.tolist(), water.offset.tolist(), strict=True)
        ],
    }
    if water.plane_of:
        content["plane_of"] = dict(water.plane_of)
    with replacing(Path(path)) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _plane(fields: Fields) -> tuple[list[float], float]:
    """Unit normal and offset; a normal that is one to the last digits stays as it is."""
    fields.only("normal", "offset")
    normal, offset = fields.numbers("normal", 3), fields.number("offset")
    length = math.hypot(*normal)
    if length == 0.0:
        raise fields.fail("normal", "has length zero, but must point up, out of the water")
    if abs(length - 1.0) <= 4.0 * sys.float_info.epsilon:
        return normal, offset
    return [component / length for component in normal], offset / length
