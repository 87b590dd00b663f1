"""What a water surface that is not flat does to pixels: their derivatives in its slope where their rays meet it."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.scene import Observations, Scene


class SurfaceSlope(NamedTuple):
    """place: where the ray of each observation meets the surface, along the plane. by_slope: derivative of its pixel in
    the surface's slope there, pixels per radian, along the two axes of `place`; zero for what is seen straight."""

    place: Float[Tensor, "k 2"]
    by_slope: Float[Tensor, "k 2 2"]


def surface_slope(scene: Scene, seen: Observations) -> SurfaceSlope:
    """Of the observations `seen` of a scene's points.

    A surface of slope (s, t) along the tangents a, b has the normal n - s a - t b. The plane is tilted so about the
    place itself, whose height stays, from the closed-form derivatives in the tilts and the height of the whole plane.
    """
    camera, points = scene.camera_of(seen.view), scene.points[seen.point]
    pixels, by, valid = camera.project_with_jacobians(points)
    meets, _, _, refracted = camera.follow_rays(pixels)
    interfaces = scene.interfaces
    first, second = interfaces.planes.tangents_like(points)
    of = scene.views.interface[seen.view]
    place = torch.stack(((first[of] * meets).sum(-1), (second[of] * meets).sum(-1)), dim=-1)
    beyond = (interfaces.normal[of] * points).sum(dim=-1) < interfaces.offset[of]
    about_first = by.plane_tilt[..., 0] - by.plane_height * place[:, 1:]
    about_second = by.plane_tilt[..., 1] + by.plane_height * place[:, :1]
    by_slope = torch.stack((-about_second, about_first), dim=-1)
    if scene.dry is not None:
        beyond = beyond & ~scene.dry[seen.point]
    usable = (valid & refracted & beyond)[:, None, None]
    return SurfaceSlope(place, torch.where(usable, by_slope, 0.0))
