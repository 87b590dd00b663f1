"""Points from the rays of cameras, whether the rays stay in air or enter the water."""

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.minimal import triangulate, triangulation_angle


def triangulate_rays(camera: RefractiveCamera, pixels: Tensor, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points (T, 3) of tracks seen at pixels (T, n, 2) by a camera batch (T, n), where `present` (T, n).

    The bent rays decide first; if they meet above the surface, the point lies in air and the straight rays do.
    Returns points, largest angle between rays (T, radians) and validity (T).
    """
    origins, directions, _ = camera.cast_rays(pixels)
    points, valid = triangulate(origins, directions, present.to(pixels.dtype))
    angle = triangulation_angle(directions, present)
    dry = points[..., 2] >= 0.0
    in_air = camera.view_directions(pixels)
    dry_points, dry_valid = triangulate(camera.center_in_world.expand_as(origins), in_air, present.to(pixels.dtype))
    points = torch.where(dry[..., None], dry_points, points)
    angle = torch.where(dry, triangulation_angle(in_air, present), angle)
    return points, angle, torch.where(dry, dry_valid, valid)
