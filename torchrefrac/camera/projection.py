"""The refractive projection as a function of tensors: lift the point, turn it into the camera, pinhole, distortion."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera.distortion import distort_components
from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.geometry import triples
from torchrefrac.geometry.triples import Mask, Part, Triple, Vectors
from torchrefrac.numerics import in_blocks
from torchrefrac.numerics.blocks import AnyTensor
from torchrefrac.refraction import FlatInterface
from torchrefrac.refraction.interface import parameter_dims
from torchrefrac.refraction.lift import Sight, is_valid, look, offset_components, precise, solve_height

MIN_DEPTH = 1e-9


class View(NamedTuple):
    """One block of operands: rotation as rows, focal, principal_point and distortion as components (with the mask of
    fisheyes), and the sight line in the interface's frame, which is the camera's where `in_camera`."""

    rotation: tuple[Triple, Triple, Triple]
    focal: Sequence[Part]
    principal_point: Sequence[Part]
    distortion: Sequence[Part]
    fisheye: Mask | None
    sight: Sight
    in_camera: bool


def project(
    intrinsics: Intrinsics,
    rotation: Float[Tensor, "*#batch 3 3"],
    center: Vectors,
    points: Vectors,
    interface: FlatInterface,
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Pixels of world points, validity, and which points lie beyond the first surface.

    rotation: cam_from_world; batches broadcast. Entries that are not valid are finite.
    """

    def block(*tensors: AnyTensor) -> tuple[AnyTensor, Mask, Mask]:
        view = view_of(tensors, interface)
        straight = -view.sight.along
        height = straight if interface.is_absent else solve_height(view.sight, interface.camera_in_rarest)
        x, y, _, ahead = onto_plane(in_camera(view, height))
        u, v = distort_components(x, y, view.distortion, view.fisheye)
        (fx, fy), (cx, cy) = view.focal, view.principal_point
        pixels = torch.stack((fx * u + cx, fy * v + cy), dim=-1)
        return pixels, is_valid(view.sight, height) & ahead, view.sight.beyond > 0

    tensors, event_dims = operands(intrinsics, rotation, center, points, interface)
    pixels, valid, beyond = in_blocks(precise(block, interface), tensors, event_dims, (1, 0, 0))
    return pixels, valid, beyond


def operands(
    intrinsics: Intrinsics,
    rotation: Float[Tensor, "*#batch 3 3"],
    center: Vectors,
    points: Vectors,
    interface: FlatInterface,
) -> tuple[list[AnyTensor], list[int]]:
    """What a projection depends on, as tensors that `in_blocks` can cut up, and how many dimensions of each belong to
    one element."""
    parameters = interface.parameters(points)
    optics = [intrinsics.focal, intrinsics.principal_point, intrinsics.distortion]
    dims = [1, 1, 1]
    if intrinsics.fisheye is not None:
        optics, dims = [*optics, intrinsics.fisheye], [*dims, 0]
    return [rotation, center, points, *optics, *parameters], [2, 1, 1, *dims, *parameter_dims(parameters)]


def view_of(tensors: Sequence[AnyTensor], interface: FlatInterface) -> View:
    """The operands taken apart."""
    rotation, center, points, focal, principal_point, distortion, *parameters = tensors
    fisheye = parameters.pop(0) if parameters[0].dtype == torch.bool else None
    rows, c, p = triples.rows(rotation), triples.split(center), triples.split(points)
    if interface.moves_with_camera:
        offset = triples.minus(p, c)
        p = triples.rotated(rows, offset)
        zero = torch.zeros_like(p[0])
        c = (zero, zero, zero)
    f, middle, k = (values.unbind(dim=-1) for values in (focal, principal_point, distortion))
    return View(rows, f, middle, k, fisheye, look(c, p, parameters), interface.moves_with_camera)


def in_camera(view: View, height: Part) -> Triple:
    """The apparent offset in the camera's frame, for the apparent height H."""
    offset = offset_components(view.sight, height)
    return offset if view.in_camera else triples.rotated(view.rotation, offset)


def onto_plane(x_in_cam: Triple) -> tuple[Part, Part, Part, Mask]:
    """x/z, y/z, 1/z, and whether the point lies ahead; where not, z counts as 1."""
    x, y, z = x_in_cam
    ahead = z > MIN_DEPTH
    inverse = torch.where(ahead, z, 1.0).reciprocal()
    return x * inverse, y * inverse, inverse, ahead
