"""Points lifted to where they appear to be: refraction as a change of the point, before the pinhole.

Seen from the centre c through layers with the unit normal n, the point p appears in the direction of
offset = u - H n: u is the part of p - c along the layers, H the apparent height (see `layers`). A pinhole that
looks along `offset` completes the exact projection (Chang & Chen, ICCV 2011, Eq. 21, for one water surface).
"""

from collections.abc import Sequence
from functools import reduce
from operator import and_
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import triples
from torchrefrac.geometry.triples import Mask, Part, Triple, Vectors
from torchrefrac.numerics import in_blocks, in_double
from torchrefrac.numerics.blocks import Tensors
from torchrefrac.refraction.interface import FlatInterface, Parameter, parameter_dims, split_parameters
from torchrefrac.refraction.layers import HeightPartials, apparent_height, apparent_height_partials


class Sight(NamedTuple):
    """A camera, a point and the layers between them.

    height: of the camera above the first surface; beyond: of the point below it, negative on the camera's side;
    along: p - c along the normal; horizontal: the rest of p - c; distance_sq: its square; bent: whether light is
    refracted on the way: where not, safe_height and thickness can be solved all the same. thickness: the way through
    each layer behind the camera's; indices: of each, relative to the camera's; ends_here: whether the point lies in it.
    """

    center: Triple
    point: Triple
    normal: Triple
    height: Part
    beyond: Part
    along: Part
    horizontal: Triple
    distance_sq: Part
    bent: Mask
    safe_height: Part
    thickness: list[Part]
    indices: list[Part]
    ends_here: list[Mask]


class Lift(NamedTuple):
    """Apparent height H and its derivatives: in the camera's height above the first surface, in the point's depth
    below it, in the squared horizontal distance, in the index of every later layer relative to the camera's, and in the
    thickness of every layer between the first and the last, which the rest of the way gets shorter by."""

    height: Part
    by_height: Part
    by_depth: Part
    by_distance_sq: Part
    by_index: list[Part]
    by_thickness: list[Part]


def lift_points(
    center: Vectors, points: Vectors, interface: FlatInterface
) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
    """Apparent offset of points seen from `center`, and a validity mask.

    All in the interface's frame. Points on the camera's side of the first surface are seen where they are. An entry
    that is not valid (centre not on the camera's side) gets the straight offset. Without refraction the offset is
    p - c, to the last bit where the normal is an axis, and always valid. Stacks are solved in double precision
    whatever the dtype: how deep a point lies in its layer is a difference of sums.
    """
    if interface.is_absent:
        batch = torch.broadcast_shapes(points.shape[:-1], center.shape[:-1], interface.shape)
        offset = (points - center).expand((*batch, 3))
        return offset, torch.ones_like(offset[..., 0], dtype=torch.bool)

    def lift(center: Vectors, points: Vectors, *parameters: Parameter) -> tuple[Vectors, Mask]:
        sight = look(triples.split(center), triples.split(points), parameters)
        height = solve_height(sight, interface.camera_in_rarest)
        return torch.stack(offset_components(sight, height), dim=-1), is_valid(sight, height)

    parameters = interface.parameters(points)
    dims = (1, 1, *parameter_dims(parameters))
    offset, valid = in_blocks(precise(lift, interface), (center, points, *parameters), dims, (1, 0))
    return offset, valid


def precise(function: Tensors, interface: FlatInterface) -> Tensors:
    """`function` of sight lines in the precision that the interface asks for: double for stacks, see `lift_points`."""
    return function if interface.layers is None else in_double(function)


def look(center: Triple, point: Triple, parameters: Sequence[Parameter]) -> Sight:
    """Take the sight line apart; `parameters` are those of `FlatInterface.parameters`."""
    normal, offset, (first, *index), inner = split_parameters(parameters)
    n = triples.split(normal)
    straight = triples.minus(point, center)
    along = triples.dot(n, straight)
    height, beyond = triples.dot(n, center) - offset, offset - triples.dot(n, point)
    horizontal = triples.add_scaled(straight, along, n, sign=-1.0)
    bent = (height > 0) & (beyond > 0)
    thickness, ends_here, rest = [], [], beyond
    for d in inner:
        thickness.append(torch.where(bent & (rest > 0), torch.where(rest <= d, rest, d), 0.0))
        ends_here.append((rest > 0) & (rest <= d))
        rest = rest - d
    thickness.append(torch.where(bent & (rest > 0), rest, 0.0))
    ends_here.append(rest > 0)
    distance_sq, safe_height = triples.dot(horizontal, horizontal), torch.where(bent, height, 1.0)
    indices = [n_i / first for n_i in index]
    lengths = (height, beyond, along, horizontal, distance_sq, bent, safe_height)
    return Sight(center, point, n, *lengths, thickness, indices, ends_here)


def solve_height(sight: Sight, camera_in_rarest: bool) -> Float[Tensor, "*batch"]:
    """Apparent height H; where nothing is refracted that of the straight line, to the last bit."""
    apparent, _, reference = _solve(sight, camera_in_rarest)
    return _finish(sight, _seen_from_camera(sight, apparent, reference))


def solve_height_with_partials(sight: Sight, camera_in_rarest: bool) -> Lift:
    """`solve_height` together with its closed-form derivatives."""
    apparent, terms, reference = _solve(sight, camera_in_rarest)
    partials = apparent_height_partials(apparent, *terms)
    height = _seen_from_camera(sight, apparent, reference)
    by_distance_sq, by_height, by_layer, by_index = (
        partials if reference is None else _chain(partials, sight, apparent, height, reference)
    )
    by_depth = sum(torch.where(here, by, 0.0) for here, by in zip(sight.ends_here, by_layer, strict=True))
    assert isinstance(by_depth, Tensor)
    by_thickness, crossed = [], sight.bent
    for here, by in zip(sight.ends_here[:-1], by_layer[:-1], strict=True):
        crossed = crossed & ~here
        by_thickness.append(torch.where(crossed, by - by_depth, 0.0))
    return Lift(
        height=_finish(sight, height),
        by_height=torch.where(sight.bent, by_height, 1.0),
        by_depth=torch.where(sight.bent, by_depth, 1.0),
        by_distance_sq=torch.where(sight.bent, by_distance_sq, 0.0),
        by_index=[torch.where(sight.bent, by, 0.0) for by in by_index],
        by_thickness=by_thickness,
    )


def offset_components(sight: Sight, height: Part) -> Triple:
    """u - H n."""
    return triples.add_scaled(sight.horizontal, height, sight.normal, sign=-1.0)


def is_valid(sight: Sight, height: Part) -> Bool[Tensor, "*batch"]:
    """Mask: the camera stands on its side of the first surface, or nothing refracts."""
    return ((sight.height > 0) | _same_media(sight)) & height.isfinite()


def _solve(sight: Sight, camera_in_rarest: bool) -> tuple[Part, tuple[Part, Part, list[Part], list[Part]], Part | None]:
    """G, the terms it was solved from, and the index of the camera's medium relative to the rarest (None: 1)."""
    if camera_in_rarest:
        terms = (sight.distance_sq, sight.safe_height, sight.thickness, sight.indices)
        return apparent_height(*terms), terms, None
    one = torch.ones_like(sight.indices[0])
    rarest = one
    for d, n in zip(sight.thickness, sight.indices, strict=True):
        rarest = torch.where(d > 0, torch.minimum(rarest, n.detach()), rarest)
    index = [one / rarest, *(torch.where(n < rarest, 1.0, n / rarest) for n in sight.indices)]
    thickness = [sight.safe_height, *sight.thickness]
    terms = (sight.distance_sq, torch.zeros_like(sight.safe_height), thickness, index)
    return apparent_height(*terms), terms, index[0]


def _seen_from_camera(sight: Sight, apparent: Part, reference: Part | None) -> Float[Tensor, "*batch"]:
    if reference is None:
        return apparent
    excess = (reference - 1.0) * (reference + 1.0)
    return (reference.square() * apparent.square() + excess * sight.distance_sq).sqrt()


def _chain(partials: HeightPartials, sight: Sight, apparent: Part, height: Part, reference: Part) -> HeightPartials:
    """From derivatives of G to those of H = sqrt(n_0^2 G^2 + (n_0^2 - 1) D), n_0 = `reference`.

    H depends on ratios of indices only, so its derivative in n_i / n_0 is n_0 times that in n_i.
    """
    slope = reference.square() * apparent / height
    by_height, *by_layer = (slope * by for by in partials.by_thickness)
    by_index = tuple(reference * slope * by for by in partials.by_index[1:])
    excess = (reference - 1.0) * (reference + 1.0)
    by_distance_sq = slope * partials.by_distance_sq + 0.5 * excess / height
    return HeightPartials(by_distance_sq, by_height, tuple(by_layer), by_index)


def _finish(sight: Sight, height: Part) -> Float[Tensor, "*batch"]:
    """The straight line's height where nothing is refracted; its derivative in the index survives there."""
    straight = -sight.along
    exact = torch.where(_same_media(sight), height + (straight - height).detach(), height)
    return torch.where(sight.bent, exact, straight)


def _same_media(sight: Sight) -> Bool[Tensor, "*batch"]:
    return reduce(and_, (n == 1.0 for n in sight.indices))
