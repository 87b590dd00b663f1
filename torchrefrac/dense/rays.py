"""What a pixel looks along: a ray that is bent at the water, and may end before or after it."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera, projection_parts


class PixelRays(NamedTuple):
    """Rays (*B) parametrised by one signed distance: 0 at the water, positive beyond it, negative on the camera's side.

    entry, origin (*B, 3): where the ray meets the first surface, and where it enters the last medium, the same point of
    a water surface; before, after (*B, 3): unit directions on either side. Nothing lies within a wall between the two.
    """

    entry: Tensor
    origin: Tensor
    before: Tensor
    after: Tensor

    @classmethod
    def cast(cls, camera: RefractiveCamera, pixels: Tensor) -> "PixelRays":
        """Those of pixels (*B, 2). A ray that never meets the water is straight and starts at the centre."""
        origin, before, after, valid = camera.follow_rays(pixels)
        entry = origin
        if len(camera.interface.indices) > 2:  # a wall
            plane = camera.plane_in_world()
            center = camera.center_in_world.expand(before.shape)
            approach = -(plane.normal_like(before) * before).sum(dim=-1)
            way = plane.signed_distance(center) / torch.where(valid, approach, 1.0)
            entry = torch.where(valid[..., None], center + way[..., None] * before, origin)
        return cls(entry, origin, before, after)

    def at(self, distance: Tensor) -> Tensor:
        """Points (*B, 3) at distances (*B)."""
        nearer = (distance < 0)[..., None]
        start = self.origin if self.entry is self.origin else torch.where(nearer, self.entry, self.origin)
        return start + distance[..., None] * torch.where(nearer, self.before, self.after)

    def direction_at(self, distance: Tensor) -> Tensor:
        """Derivatives (*B, 3) of `at`."""
        return torch.where((distance < 0)[..., None], self.before, self.after)

    def meet(self, point: Tensor, normal: Tensor) -> Tensor:
        """Distances (*B) at which the rays meet the plane through `point` (*B, 3) with `normal` (*B, 3).

        A ray that meets it on the camera's side is met there. Infinite or far where a ray runs along the plane.
        """
        beyond = ((point - self.origin) * normal).sum(dim=-1) / (self.after * normal).sum(dim=-1)
        here = ((point - self.entry) * normal).sum(dim=-1) / (self.before * normal).sum(dim=-1)
        return torch.where(here < 0, here, beyond)

    def distance_of(self, points: Tensor) -> Tensor:
        """Distances (*B) of the points of the rays that are nearest to `points` (*B, 3)."""
        beyond = ((points - self.origin) * self.after).sum(dim=-1)
        here = ((points - self.entry) * self.before).sum(dim=-1)
        return torch.where((beyond < 0) | (here < 0), here.clamp(max=0.0), beyond)

    def __getitem__(self, index: Tensor | tuple[Tensor | slice | None, ...]) -> "PixelRays":  # type: ignore[override]
        origin = self.origin[index]
        entry = origin if self.entry is self.origin else self.entry[index]
        return PixelRays(entry, origin, self.before[index], self.after[index])


def project_moving(camera: RefractiveCamera, points: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (*B, 2) of points (*B, 3), their derivatives (*B, 2) as the points move along `direction` (*B, 3), and
    which the camera sees (*B). In closed form, for cameras (*B)."""
    (u, v), valid, by = projection_parts(
        camera.intrinsics, camera.cam_from_world_rotation, camera.center_in_world, points, camera.interface, ("point",)
    )
    dx, dy, dz = direction.unbind(dim=-1)
    along = torch.stack([row[0] * dx + row[1] * dy + row[2] * dz for row in by["point"]], dim=-1)
    return torch.stack((u, v), dim=-1), along, valid


def depth_in(camera: RefractiveCamera, points: Tensor) -> Tensor:
    """z (k) of points (k, 3) in the frame of a single camera: true depths, not the apparent ones."""
    return ((points - camera.center_in_world) * camera.cam_from_world_rotation[2]).sum(dim=-1)
