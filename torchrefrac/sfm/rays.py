"""Points from the rays of cameras, whether the rays stay in air or enter the water."""

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.minimal import triangulate, triangulation_angle
from torchrefrac.refraction import refract_rays


def triangulate_rays(camera: RefractiveCamera, pixels: Tensor, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points (T, 3) of tracks seen at pixels (T, n, 2) by a camera batch (T, n), where `present` (T, n).

    The bent rays decide first; if they meet above the surface, the point lies in air and the straight rays do.
    Returns points, largest angle between rays (T, radians) and validity (T).
    """
    weights = present.to(pixels.dtype)
    in_air, origins, in_water = _rays(camera, pixels)
    points, valid = triangulate(origins, in_water, weights)
    dry = points[..., 2] >= 0.0
    dry_points, dry_valid = triangulate(camera.center_in_world.expand_as(origins), in_air, weights)
    points = torch.where(dry[..., None], dry_points, points)
    angle = _opening(in_water, in_air, present, dry)
    return points, angle, torch.where(dry, dry_valid, valid)


def opening_angle(camera: RefractiveCamera, pixels: Tensor, present: Tensor, points: Tensor) -> Tensor:
    """Largest angle (T, radians) at which the rays of each track meet in its point (T, 3), in water or in air."""
    in_air, _, in_water = _rays(camera, pixels)
    return _opening(in_water, in_air, present, points[..., 2] >= 0.0)


def _rays(camera: RefractiveCamera, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Directions in air, and origins and directions in the water (T, n, 3)."""
    in_air = camera.view_directions(pixels)
    origins, in_water, _ = refract_rays(camera.center_in_world, in_air, camera.interface)
    return in_air, origins, in_water


def _opening(in_water: Tensor, in_air: Tensor, present: Tensor, dry: Tensor) -> Tensor:
    return triangulation_angle(torch.where(dry[..., None, None], in_air, in_water), present)
