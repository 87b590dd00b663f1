"""What a pixel looks along: a ray that is bent at the water, and may end before or after it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera import RefractiveCamera, projection_along


class PixelRays(NamedTuple):
    """Rays (*B) parametrised by one signed distance: 0 at the water, positive beyond it, negative on the camera's side.

    entry, origin: where the ray meets the first surface, and where it enters the last medium, the same point of
    a water surface; before, after: unit directions on either side. Nothing lies within a wall between the two.
    """

    entry: Float[Tensor, "*batch 3"]
    origin: Float[Tensor, "*batch 3"]
    before: Float[Tensor, "*batch 3"]
    after: Float[Tensor, "*batch 3"]

    @classmethod
    def cast(cls, camera: RefractiveCamera, pixels: Float[Tensor, "*batch 2"]) -> "PixelRays":
        """Those of pixels. A ray that never meets the water is straight and starts at the centre."""
        origin, before, after, valid = camera.follow_rays(pixels)
        entry = origin
        if len(camera.interface.indices) > 2:  # a wall
            plane = camera.plane_in_world()
            center = camera.center_in_world.expand(before.shape)
            approach = -(plane.normal_like(before) * before).sum(dim=-1)
            way = plane.signed_distance(center) / torch.where(valid, approach, 1.0)
            entry = torch.where(valid[..., None], center + way[..., None] * before, origin)
        return cls(entry, origin, before, after)

    def at(self, distance: Float[Tensor, "*given"]) -> Float[Tensor, "*batch 3"]:
        """Points at distances, which broadcast against the rays."""
        nearer = (distance < 0)[..., None]
        start = self.origin if self.entry is self.origin else torch.where(nearer, self.entry, self.origin)
        return start + distance[..., None] * torch.where(nearer, self.before, self.after)

    def direction_at(self, distance: Float[Tensor, "*given"]) -> Float[Tensor, "*batch 3"]:
        """Derivatives of `at`."""
        return torch.where((distance < 0)[..., None], self.before, self.after)

    def meet(self, point: Float[Tensor, "*#plane 3"], normal: Float[Tensor, "*#plane 3"]) -> Float[Tensor, "*batch"]:
        """Distances at which the rays meet the plane through `point` with `normal`. A ray that meets it on the camera's
        side is met there. Infinite or far where a ray runs along the plane."""
        beyond = ((point - self.origin) * normal).sum(dim=-1) / (self.after * normal).sum(dim=-1)
        here = ((point - self.entry) * normal).sum(dim=-1) / (self.before * normal).sum(dim=-1)
        return torch.where(here < 0, here, beyond)

    def distance_of(self, points: Float[Tensor, "*given 3"]) -> Float[Tensor, "*batch"]:
        """Distances of the points of the rays that are nearest to `points`."""
        beyond = ((points - self.origin) * self.after).sum(dim=-1)
        here = ((points - self.entry) * self.before).sum(dim=-1)
        return torch.where((beyond < 0) | (here < 0), here.clamp(max=0.0), beyond)

    def __getitem__(self, index: Any) -> "PixelRays":  # type: ignore[override]
        """Some of them, as one indexes a tensor (*batch)."""
        origin = self.origin[index]
        entry = origin if self.entry is self.origin else self.entry[index]
        return PixelRays(entry, origin, self.before[index], self.after[index])

    @classmethod
    def together(cls, parts: Sequence["PixelRays"]) -> "PixelRays":
        """Several, one after the other."""
        entry, origin, before, after = (torch.cat(vectors) for vectors in zip(*parts, strict=True))
        return cls(origin if all(part.entry is part.origin for part in parts) else entry, origin, before, after)


def project_moving(
    camera: RefractiveCamera, points: Float[Tensor, "*#batch 3"], direction: Float[Tensor, "*#batch 3"]
) -> tuple[Float[Tensor, "*seen 2"], Float[Tensor, "*seen 2"], Bool[Tensor, "*seen"]]:
    """Pixels of points, their derivatives as the points move along `direction`, and which the camera sees. In closed
    form, for cameras that broadcast against the points."""
    pixel, along, valid = projection_along(
        camera.intrinsics, camera.cam_from_world_rotation, camera.center_in_world, points, direction, camera.interface
    )
    return torch.stack(pixel, dim=-1), torch.stack(along, dim=-1), valid


def depth_in(camera: RefractiveCamera, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """z of points in the frame of a single camera: true depths, not the apparent ones."""
    return ((points - camera.center_in_world) * camera.cam_from_world_rotation[2]).sum(dim=-1)
