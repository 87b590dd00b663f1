"""`water.json`: where the water surfaces lie in the frame of a scene, and how strongly they refract."""

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.files.fields import Fields, scene_fields, write_json
from torchrefrac.files.interface import INTERFACES, interface_content, read_index_ratio, read_placed
from torchrefrac.scene import Interfaces, Scene
from torchrefrac.scene.interfaces import SURFACE

WATER, FORMAT, PLACES = "water.json", "torchrefrac-water/1", "torchrefrac-water/2"
"""The second format has interfaces of any kind, with layers between air and water."""


def read_water(path: str | Path, names: Sequence[str]) -> tuple[Interfaces, Int[Tensor, " m"]]:
    """Read the surfaces of `water.json`, and which of them (its row) each of the images `names` looks through.

    A normal of any length but zero defines its plane by normal . x = offset: both are scaled by the length. Where there
    is one plane every image looks through it, listed or not. Raises SceneError, with the file and the field, for
    anything that cannot be right, and where `plane_of` lacks an image.
    """
    path = Path(path)
    with scene_fields(path) as top:
        if top.must_be("format", FORMAT, PLACES) == PLACES:
            top.only("format", "length_unit", INTERFACES, "interface_of")
            top.length_unit()
            placed = read_placed(top)
            return placed, _planes_of(top, names, len(placed), "interface_of")
        top.only("format", "length_unit", "index_ratio", "planes", "plane_of")
        top.length_unit()
        planes = [_plane(fields) for fields in top.objects("planes")]
        if not planes:
            raise top.fail("planes", "is empty, but must list at least one plane")
        ratio = torch.full((len(planes),), read_index_ratio(top), dtype=torch.float64)
        normal, offset = (torch.tensor(column, dtype=torch.float64) for column in zip(*planes, strict=True))
        return Interfaces(normal, offset, ratio), _planes_of(top, names, len(planes), "plane_of")


def with_water(scene: Scene, path: str | Path) -> Scene:
    """The scene behind the surfaces of `water.json`. Raises what `read_water` does."""
    interfaces, rows = read_water(path, scene.views.names)
    return replace(scene, interfaces=interfaces, views=replace(scene.views, interface=rows))


def write_water(scene: Scene, path: str | Path) -> None:
    """Write `water.json`. Raises SceneError where the index ratios of the surfaces differ."""
    surfaces, views = scene.interfaces, scene.views
    if surfaces.has_layers or set(surfaces.kinds) != {SURFACE}:
        placed: dict[str, object] = {"format": PLACES, "length_unit": scene.length_unit}
        placed[INTERFACES] = [interface_content(surfaces, row) for row in range(len(surfaces))]
        if len(surfaces) > 1:
            placed["interface_of"] = dict(zip(views.names, views.interface.tolist(), strict=True))
        write_json(placed, Path(path))
        return
    planes = zip(surfaces.normal.tolist(), surfaces.offset.tolist(), strict=True)
    content: dict[str, object] = {
        "format": FORMAT,
        "length_unit": scene.length_unit,
        "index_ratio": scene.index_ratio,
        "planes": [{"normal": normal, "offset": offset} for normal, offset in planes],
    }
    if len(surfaces) > 1:
        content["plane_of"] = dict(zip(views.names, views.interface.tolist(), strict=True))
    write_json(content, Path(path))


def _planes_of(top: Fields, names: Sequence[str], count: int, key: str) -> Int[Tensor, " m"]:
    if key not in top and count > 1:
        raise top.fail(key, f"is missing, but with {count} planes it must say which an image looks through")
    table = top.object(key) if key in top else None
    plane_of = {} if table is None else {name: table.integer(name) for name in table.names()}
    for name, plane in plane_of.items():
        if not 0 <= plane < count:
            raise top.fail(f"{key}[{name!r}]", f"is {plane}, but must lie in 0 to {count - 1}, one of the planes")
    missing = [name for name in names if name not in plane_of] if count > 1 else []
    if missing:
        wanted = f"with {count} planes it must say for each image which it looks through"
        raise top.fail(key, f"lacks {len(missing)} of {len(names)} images, {missing[0]} first; {wanted}")
    return torch.tensor([plane_of[name] if count > 1 else 0 for name in names], dtype=torch.long)


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
