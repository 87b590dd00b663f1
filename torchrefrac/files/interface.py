"""What capture.json, truth.json and cameras.json say of the layers that light is bent at."""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.files.fields import FARTHEST, Fields
from torchrefrac.scene.interfaces import (
    INDEX_RATIO_RANGE,
    KINDS,
    MAX_INDEX_RATIO,
    PORT,
    SURFACE,
    WALL,
    Interfaces,
    Kind,
)

INTERFACE, INTERFACES = "interface", "interfaces"
MOST_TILT_DEG = 45.0
OF_LAYER = {"layer_index": "index_sigma", "layer_thickness": "thickness_sigma"}
OF_PORT, OF_WALL, OF_ANY = ("normal_in_cam", "distance", "distance_sigma"), ("normal", "offset"), ("kind", "layers")


def read_index_ratio(top: Fields) -> float:
    """n_water / n_air of what `top` states: by `interface`, or by `index_ratio` for short."""
    return float(read_interfaces(top).index_ratio[0])


def read_interfaces(top: Fields) -> Interfaces:
    """What `top` states: by `interface`, by `interfaces` where there are several, or by `index_ratio` for short."""
    given = [name for name in (INTERFACE, INTERFACES) if name in top]
    if not given:
        return Interfaces.level(_index_ratio(top))
    for other in ("index_ratio", *given[1:]):
        if other in top:
            raise top.fail(other, f"is given beside {given[0]}; leave it out, or state it there")
    if given == [INTERFACE]:
        return _read_interface(top.object(INTERFACE), alone=True)
    members = [*top.members(INTERFACES).values()]
    if not members:
        raise top.fail(INTERFACES, "is empty, but must describe at least one interface")
    every = [_read_interface(fields, alone=len(members) == 1) for fields in members]
    joined = Interfaces.joined(every)
    if problem := joined.problem():
        raise top.fail(INTERFACES, f"cannot be used: {problem}")
    return joined


def interface_of_images(top: Fields, images: Sequence[Fields]) -> Int[Tensor, " m"]:
    """Which of `interfaces` each image looks through."""
    names = [*top.members(INTERFACES)] if INTERFACES in top else [""]
    rows = []
    for image in images:
        if len(names) == 1:
            if INTERFACE in image:
                image.must_be(INTERFACE, *names)
            rows.append(0)
        else:
            rows.append(names.index(image.must_be(INTERFACE, *names)))
    return torch.tensor(rows)


def read_placed(top: Fields) -> Interfaces:
    """A list of interfaces, each with its place, as `interface_content` says it."""
    every = top.objects(INTERFACES)
    if not every:
        raise top.fail(INTERFACES, "is empty, but must list at least one interface")
    return Interfaces.joined([_read_interface(fields, alone=False) for fields in every])


def interface_content(
    interfaces: Interfaces, row: int = 0, sigmas: Mapping[str, float] | None = None
) -> dict[str, object]:
    """One of them as `read_interfaces` reads it, with its place, and with what `sigmas` says of its unknowns."""
    sigmas = sigmas or {}
    kind, layers = interfaces.kinds[row], [{"index": 1.0}]
    for index, thickness in zip(interfaces.layers[row].tolist(), interfaces.thickness[row].tolist(), strict=True):
        if thickness > 0.0:
            layers.append({"index": index, "thickness": thickness, **_named(sigmas, OF_LAYER)})
    layers.append({"index": float(interfaces.index_ratio[row]), **_named(sigmas, {"index_ratio": "index_sigma"})})
    normal, offset = interfaces.normal[row].tolist(), float(interfaces.offset[row])
    if kind != PORT:
        return {"kind": kind, "layers": layers, "normal": normal, "offset": offset}
    place = {"normal_in_cam": normal, "distance": -offset, **_named(sigmas, {"plane_height": "distance_sigma"})}
    tilt = {"tilt_sigma_deg": math.degrees(sigmas["plane_tilt"])} if sigmas.get("plane_tilt") else {}
    return {"kind": kind, "layers": layers, **place, **tilt}


def _named(sigmas: Mapping[str, float], names: Mapping[str, str]) -> dict[str, float]:
    return {name: sigmas[key] for key, name in names.items() if sigmas.get(key, 0.0) > 0.0}


def _read_interface(fields: Fields, alone: bool) -> Interfaces:
    """alone: there is no other, so that the frame of the scene is its own."""
    kind: Kind = SURFACE
    if "kind" in fields:
        kind = next(one for one in KINDS if one == fields.must_be("kind", *KINDS))
    own = (*OF_PORT, "tilt_sigma_deg") if kind == PORT else OF_WALL if kind == SURFACE else (*OF_WALL, "tilt_sigma_deg")
    fields.only(*OF_ANY, *(("index_ratio",) if kind == SURFACE else ()), *own)
    ratio, layers, thickness, sigmas = _media(fields, kind)
    if kind == WALL and "tilt_sigma_deg" in fields:
        sigmas["upright"] = math.radians(fields.positive("tilt_sigma_deg", MOST_TILT_DEG))
    if kind == PORT:
        normal, offset = _unit(fields, "normal_in_cam"), -fields.positive("distance", FARTHEST)
        if normal[2] >= 0.0:
            raise fields.fail("normal_in_cam", f"is {normal}, but must point towards the camera: z below 0")
        if "distance_sigma" in fields:
            sigmas["plane_height"] = fields.positive("distance_sigma", FARTHEST)
        if "tilt_sigma_deg" in fields:
            sigmas["plane_tilt"] = math.radians(fields.positive("tilt_sigma_deg", MOST_TILT_DEG))
    elif alone and "normal" not in fields:
        normal, offset = [0.0, 0.0, 1.0], 0.0
    else:
        for name in OF_WALL:
            if name not in fields:
                wanted = "several interfaces must say where they are in one frame: normal . x = offset"
                raise fields.fail(name, f"is missing, but {wanted}")
        normal, offset = _unit(fields, "normal"), fields.number("offset")
    table = [torch.tensor([values], dtype=torch.float64) for values in (normal, offset, ratio, layers, thickness)]
    return Interfaces(*table, kinds=(kind,), sigmas=sigmas)


def _media(fields: Fields, kind: Kind) -> tuple[float, list[float], list[float], dict[str, float]]:
    """Index ratio; index and thickness of layers between air and water; and what is known of them, by names of unknowns
    of an adjustment."""
    sigmas: dict[str, float] = {}
    if "layers" not in fields:
        if kind != SURFACE:
            raise fields.fail("layers", f"is missing, but a {kind} has three or more: air, glass and water")
        return _index_ratio(fields), [], [], sigmas
    every = fields.objects("layers")
    if len(every) < 2:
        raise fields.fail("layers", f"lists {len(every)}, but there are at least two: air and water")
    first, *inner, last = every
    for layer in (first, last):
        layer.only("index", "index_sigma")
    indices = [layer.positive("index", MAX_INDEX_RATIO) for layer in every]
    for layer in inner:
        layer.only("index", "thickness", "index_sigma", "thickness_sigma")
    below = [index for index in indices if index < indices[0]]
    if below:
        wanted = "the camera stands in the rarest of them (air: 1)"
        raise fields.fail("layers", f"has an index of {below[0]:g} beyond one of {indices[0]:g}, but {wanted}")
    thickness = [layer.positive("thickness", FARTHEST) for layer in inner]
    if len(inner) == 1:
        for name in ("index", "thickness"):
            if f"{name}_sigma" in inner[0]:
                sigmas[f"layer_{name}"] = inner[0].positive(f"{name}_sigma", FARTHEST)
    elif any(f"{name}_sigma" in layer for layer in inner for name in ("index", "thickness")):
        raise fields.fail("layers", "has sigmas of several layers before the water, but only those of one can be used")
    if "index_sigma" in last:
        sigmas["index_ratio"] = last.positive("index_sigma", FARTHEST) / indices[0]
    ratio = _within(fields, "layers", indices[-1] / indices[0])
    return ratio, [index / indices[0] for index in indices[1:-1]], thickness, sigmas


def _unit(fields: Fields, name: str) -> list[float]:
    vector = fields.numbers(name, 3)
    length = math.hypot(*vector)
    if not 1e-6 < length < math.inf:
        raise fields.fail(name, f"is {vector}, but must be a direction")
    return [part / length for part in vector]


def _index_ratio(fields: Fields) -> float:
    return _within(fields, "index_ratio", fields.number("index_ratio"))


def _within(fields: Fields, name: str, ratio: float) -> float:
    if not 1.0 <= ratio <= MAX_INDEX_RATIO:
        raise fields.fail(name, f"is {ratio:g}, but {INDEX_RATIO_RANGE}")
    return ratio
