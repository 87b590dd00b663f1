"""Closed-form derivatives of the refractive projection.

The apparent offset is e = u - H n (see `refraction.lift`), so that only H carries refraction. With v = p - c, its part
v_n along the normal, H_h, H_d, H_D the derivatives of H in height, depth and D = |u|^2,

    de/dp = I - n q^T,    q = (1 - H_d) n + 2 H_D u;        de/dc = -I - n r^T,    r = (H_h - 1) n - 2 H_D u,

a rank-one change of the pinhole's derivative. No approximation is made (the paper holds the refrax ratio constant).
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera.distortion import distortion_slopes
from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.camera.projection import View, in_camera, onto_plane, operands, view_of
from torchrefrac.geometry import triples
from torchrefrac.geometry.triples import Mask, Part, Triple, Vectors
from torchrefrac.numerics import in_blocks
from torchrefrac.numerics.blocks import AnyTensor
from torchrefrac.refraction import FlatInterface
from torchrefrac.refraction.interface import Parameter
from torchrefrac.refraction.lift import Lift, Sight, is_valid, precise, solve_height_with_partials

BLOCKS = ("rotation", "center", "point", "focal", "distortion", "indices", "thickness", "plane_tilt", "plane_height")
Axes = tuple[Sequence[Part], Sequence[Part]]


class ProjectionJacobians(NamedTuple):
    """Derivatives of pixels.

    rotation: left perturbation, R <- exp([w]x) R, radians; center, point: world frame; indices: refractive index of
    each layer behind the camera's, relative to the camera's; thickness: of each between the first and the last;
    plane_tilt, radians, and plane_height: the coordinates of `Plane.moved`.
    """

    rotation: Float[Tensor, "*batch 2 3"]
    center: Float[Tensor, "*batch 2 3"]
    point: Float[Tensor, "*batch 2 3"]
    focal: Float[Tensor, "*batch 2 2"]
    principal_point: Float[Tensor, "*batch 2 2"]
    distortion: Float[Tensor, "*batch 2 k"]
    indices: Float[Tensor, "*batch 2 layers"]
    thickness: Float[Tensor, "*batch 2 inner"]
    plane_tilt: Float[Tensor, "*batch 2 2"]
    plane_height: Float[Tensor, "*batch 2"]

    @property
    def index_ratio(self) -> Float[Tensor, "*batch 2"]:
        """Derivative in the index of the last medium relative to the camera's."""
        return self.indices[..., -1]


def project_with_jacobians(
    intrinsics: Intrinsics,
    rotation: Float[Tensor, "*#batch 3 3"],
    center: Vectors,
    points: Vectors,
    interface: FlatInterface,
) -> tuple[Float[Tensor, "*batch 2"], ProjectionJacobians, Bool[Tensor, "*batch"]]:
    """Pixels, derivatives and validity of world points seen by cameras.

    rotation: cam_from_world; batches broadcast. Entries that are not valid are finite.
    """

    empty = {"distortion": not intrinsics.distortion.shape[-1], "thickness": not len(interface.thickness)}
    wanted = [name for name in BLOCKS if not empty.get(name, False)]

    def block(first: Vectors, second: Vectors, *tensors: AnyTensor) -> tuple[AnyTensor, ...]:
        pixel, valid, by = _differentiate(tensors, interface, (triples.split(first), triples.split(second)), wanted)
        return torch.stack(pixel, dim=-1), valid, *(_stack(*by[name]) for name in wanted)

    tensors, event_dims = operands(intrinsics, rotation, center, points, interface)
    tangents = interface.plane.tangents_like(points)
    dims = (1, 0, *(2 for _ in wanted))
    pixels, valid, *blocks = in_blocks(precise(block, interface), [*tangents, *tensors], [1, 1, *event_dims], dims)
    by: dict[str, Parameter] = dict(zip(wanted, blocks, strict=True))
    for name in empty:
        by.setdefault(name, by["focal"][..., :0])
    by["plane_height"] = by["plane_height"][..., 0]
    by["principal_point"] = torch.eye(2, dtype=pixels.dtype, device=pixels.device).expand((*valid.shape, 2, 2))
    return pixels, ProjectionJacobians(**by), valid


def projection_parts(
    intrinsics: Intrinsics,
    rotation: Float[Tensor, "*#batch 3 3"],
    center: Vectors,
    points: Vectors,
    interface: FlatInterface,
    wanted: Sequence[str],
    frozen_ratio: bool = False,
) -> tuple[tuple[Part, Part], Mask, dict[str, Axes]]:
    """`project_with_jacobians` for those who lay out the numbers themselves.

    Returns the pixel's coordinates u and v, validity, and by name the derivatives of u and those of v, as many tensors
    as the block is wide, of the `wanted` blocks (fields of `ProjectionJacobians`) if of no others.
    Stacks are solved in the dtype given. All are worked through at once: hand over as many as fit the cache.

    frozen_ratio: the refrax ratio lambda counts as a constant, as in the paper (section 3.5): the refrax
    moves with camera and point, but the bend does not. A point's depth has no derivative then. An approximation.
    """
    tensors, _ = operands(intrinsics, rotation, center, points, interface)
    first, second = interface.plane.tangents_like(points)
    return _differentiate(tensors, interface, (triples.split(first), triples.split(second)), wanted, frozen_ratio)


def projection_along(
    intrinsics: Intrinsics,
    rotation: Float[Tensor, "*#batch 3 3"],
    center: Vectors,
    points: Vectors,
    directions: Vectors,
    interface: FlatInterface,
) -> tuple[tuple[Part, Part], tuple[Part, Part], Mask]:
    """The pixel's coordinates u and v, how they change as world points move along directions (per unit of these), and
    validity: what `projection_parts` says of the points times the directions, for less."""
    tensors, _ = operands(intrinsics, rotation, center, points, interface)
    view = view_of(tensors, interface)
    lift = solve_height_with_partials(view.sight, interface.camera_in_rarest)
    d = triples.split(directions)
    d = triples.rotated(view.rotation, d) if view.in_camera else d
    n, u = view.sight.normal, view.sight.horizontal
    by_q = (1.0 - lift.by_depth) * triples.dot(n, d) + 2.0 * lift.by_distance_sq * triples.dot(u, d)
    moved = triples.add_scaled(d, by_q, n, sign=-1.0)
    dx, dy, dz = moved if view.in_camera else triples.rotated(view.rotation, moved)
    x, y, inverse, ahead = onto_plane(in_camera(view, lift.height))
    dx, dy = inverse * (dx - x * dz), inverse * (dy - y * dz)
    slopes = distortion_slopes(x, y, view.distortion, view.fisheye)
    (fx, fy), (cx, cy) = view.focal, view.principal_point
    along = (fx * (slopes.du_dx * dx + slopes.mixed * dy), fy * (slopes.mixed * dx + slopes.dv_dy * dy))
    return (fx * slopes.u + cx, fy * slopes.v + cy), along, is_valid(view.sight, lift.height) & ahead


def _differentiate(
    tensors: Sequence[AnyTensor],
    interface: FlatInterface,
    tangents: tuple[Triple, Triple],
    wanted: Collection[str],
    frozen_ratio: bool = False,
) -> tuple[tuple[Part, Part], Mask, dict[str, Axes]]:
    """The pixel's two coordinates, validity, and the derivatives of either coordinate, a sequence a block."""
    view = view_of(tensors, interface)
    lift = solve_height_with_partials(view.sight, interface.camera_in_rarest)
    if frozen_ratio:
        lift = _with_frozen_ratio(view.sight, lift)
    x_in_cam = in_camera(view, lift.height)
    x, y, inverse, ahead = onto_plane(x_in_cam)
    slopes = distortion_slopes(x, y, view.distortion, view.fisheye)
    u, v = slopes.u, slopes.v
    (fx, fy), (cx, cy) = view.focal, view.principal_point
    bend = _bend(view.sight, lift, tangents, with_tilt="plane_tilt" in wanted)
    axes = []
    for f, along_x, along_y in ((fx, slopes.du_dx, slopes.mixed), (fy, slopes.mixed, slopes.dv_dy)):
        by_x, by_y = f * inverse * along_x, f * inverse * along_y
        by_offset = (by_x, by_y, -(by_x * x + by_y * y))
        axes.append(_of_axis(view, bend, x_in_cam, by_offset, wanted))
    by: dict[str, Axes] = {name: (axes[0][name], axes[1][name]) for name in axes[0]}
    zero, one = torch.zeros_like(u), torch.ones_like(u)
    by["focal"] = ((u, zero), (zero, v))
    by["principal_point"] = ((one, zero), (zero, one))
    if "distortion" in wanted:
        by["distortion"] = ([fx * slope for slope in slopes.by_u], [fy * slope for slope in slopes.by_v])
    return (fx * u + cx, fy * v + cy), is_valid(view.sight, lift.height) & ahead, by


def _with_frozen_ratio(sight: Sight, lift: Lift) -> Lift:
    """H = h / lambda with lambda a constant, where light is bent."""
    zero = torch.zeros_like(lift.height)
    by_height = torch.where(sight.bent, lift.height / sight.safe_height, lift.by_height)
    by_depth = torch.where(sight.bent, 0.0, lift.by_depth)
    none = {"by_index": [zero for _ in lift.by_index], "by_thickness": [zero for _ in lift.by_thickness]}
    return Lift(lift.height, by_height, by_depth, by_distance_sq=zero, **none)


class _Bend(NamedTuple):
    """How the apparent offset e changes beyond the straight line's change.

    In the point by -n q^T, in the centre by -n r^T; in each tilt by -n alpha - rise dn; in the height of the plane, in
    each index and in each thickness by -n times these.
    """

    q: Triple
    r: Triple
    alpha: list[Part]
    rise: Part
    dn: list[Triple]
    by_height: Part
    by_index: list[Part]
    by_thickness: list[Part]


def _bend(sight: Sight, lift: Lift, tangents: tuple[Triple, Triple], with_tilt: bool) -> _Bend:
    n, u = sight.normal, sight.horizontal
    twice_by_distance_sq = 2.0 * lift.by_distance_sq
    along_u = triples.scaled(twice_by_distance_sq, u)
    first, second = tangents
    dn: list[Triple] = [(-second[0], -second[1], -second[2]), first]  # turning about t moves n by t x n
    by_straight = 1.0 - twice_by_distance_sq * sight.along
    by_point, by_center = by_straight - lift.by_depth, lift.by_height - by_straight
    tilts = dn if with_tilt else []
    alpha = [by_point * triples.dot(sight.point, d) + by_center * triples.dot(sight.center, d) for d in tilts]
    return _Bend(
        q=triples.add_scaled(along_u, 1.0 - lift.by_depth, n),
        r=triples.add_scaled(triples.scaled(lift.by_height - 1.0, n), twice_by_distance_sq, u, sign=-1.0),
        alpha=alpha,
        rise=sight.along + lift.height,
        dn=tilts,
        by_height=lift.by_depth - lift.by_height,
        by_index=lift.by_index,
        by_thickness=lift.by_thickness,
    )


def _of_axis(
    view: View, bend: _Bend, x_in_cam: Triple, by_offset: Triple, wanted: Collection[str]
) -> dict[str, Sequence[Part]]:
    """Derivatives of one pixel coordinate, given that in the apparent offset in the camera's frame."""
    g = by_offset if view.in_camera else _to_world(view, by_offset)
    g_n = triples.dot(g, view.sight.normal)
    by: dict[str, Sequence[Part]] = {}
    by_point = triples.add_scaled(g, g_n, bend.q, sign=-1.0)
    if view.in_camera:
        by["rotation"] = triples.cross(view.sight.point, by_point)
        by_point = _to_world(view, by_point)
        by["center"] = (-by_point[0], -by_point[1], -by_point[2])
    else:
        if "rotation" in wanted:
            by["rotation"] = triples.cross(x_in_cam, by_offset)
        if "center" in wanted:
            by["center"] = triples.add_scaled((-g[0], -g[1], -g[2]), g_n, bend.r, sign=-1.0)
    by["point"] = by_point
    by["plane_tilt"] = [
        -alpha * g_n - bend.rise * triples.dot(g, dn) for alpha, dn in zip(bend.alpha, bend.dn, strict=True)
    ]
    if "indices" in wanted:
        by["indices"] = [-g_n * by_index for by_index in bend.by_index]
    if "thickness" in wanted:
        by["thickness"] = [-g_n * by_thickness for by_thickness in bend.by_thickness]
    if "plane_height" in wanted:
        by["plane_height"] = [-g_n * bend.by_height]
    return by


def _to_world(view: View, row: Triple) -> Triple:
    """A row vector in the camera's frame times cam_from_world: row R."""
    first, second, third = view.rotation
    return triples.add_scaled(triples.add_scaled(triples.scaled(row[0], first), row[1], second), row[2], third)


def _stack(u_part: Sequence[Part], v_part: Sequence[Part]) -> Float[Tensor, "*batch 2 k"]:
    """One block from the k derivatives of u and those of v."""
    entries = torch.broadcast_tensors(*u_part, *v_part)
    return torch.stack(entries).unflatten(0, (2, len(u_part))).movedim((0, 1), (-2, -1))
