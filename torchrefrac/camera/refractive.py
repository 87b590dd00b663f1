"""A camera above a flat water surface."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.camera.jacobians import MIN_DEPTH, ProjectionJacobians, project_with_jacobians
from torchrefrac.refraction import FlatInterface, lift_points, refract_rays


@dataclass(frozen=True)
class RefractiveCamera:
    """A batch of cameras in air that look at points under water (or above it) through `interface`.

    cam_from_world_rotation (*B, 3, 3), camera x right, y down, z forward; center_in_world (*B, 3), world z up
    with the water surface at z = 0. The batch broadcasts against the leading dimensions of what is projected:
    give points (N, 3) to one camera, or index a batch of M cameras as `camera[:, None]` for an (M, N) grid.
    """

    intrinsics: Intrinsics
    cam_from_world_rotation: Tensor
    center_in_world: Tensor
    interface: FlatInterface

    def __post_init__(self) -> None:
        if self.cam_from_world_rotation.shape[-2:] != (3, 3):
            shape = tuple(self.cam_from_world_rotation.shape)
            raise ValueError(f"cam_from_world_rotation has shape {shape}, but must end in (3, 3)")
        if self.center_in_world.shape[-1:] != (3,):
            raise ValueError(f"center_in_world has shape {tuple(self.center_in_world.shape)}, but must end in (3,)")

    def __getitem__(self, index: Any) -> "RefractiveCamera":
        """Index the batch dimensions as one indexes a tensor: `camera[3]`, `camera[:, None]`.

        What is not batched, but shared by all cameras (intrinsics, index ratio), stays shared.
        """
        ratio = self.interface.index_ratio
        interface = FlatInterface(ratio[index]) if isinstance(ratio, Tensor) and ratio.dim() else self.interface
        lens = self.intrinsics
        if lens.focal.dim() > 1:
            focal, principal, distortion = lens.focal, lens.principal_point, lens.distortion
            lens = Intrinsics(lens.width, lens.height, focal[index], principal[index], distortion[index])
        return RefractiveCamera(lens, self.cam_from_world_rotation[index], self.center_in_world[index], interface)

    def project(self, points_in_world: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (*B, 2) of world points (*B, 3), and a mask (*B) of those in front of a camera above water.

        Exact (Chang & Chen, Eq. 21); differentiable in the points, the pose, the intrinsics and the index ratio.
        """
        index = self.interface.index_like(points_in_world)
        offset, valid = lift_points(self.center_in_world, points_in_world, index)
        x_in_cam = (self.cam_from_world_rotation @ offset[..., None])[..., 0]
        ahead = x_in_cam[..., 2] > MIN_DEPTH
        depth = torch.where(ahead, x_in_cam[..., 2], 1.0)
        return self.intrinsics.pixels_from_plane(x_in_cam[..., :2] / depth[..., None]), valid & ahead

    def project_with_jacobians(self, points_in_world: Tensor) -> tuple[Tensor, ProjectionJacobians, Tensor]:
        """Pixels, their closed-form derivatives and the mask of `project`."""
        return project_with_jacobians(
            self.intrinsics,
            self.cam_from_world_rotation,
            self.center_in_world,
            points_in_world,
            self.interface.index_like(points_in_world),
        )

    def cast_rays(self, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The rays in the water that pixels (*B, 2) see.

        Returns the refrax points on the surface (*B, 3), unit directions in the water (*B, 3), and a mask (*B):
        False for rays that do not meet the water, which are returned straight, from the centre.
        """
        index = self.interface.index_like(pixels)
        return refract_rays(self.center_in_world, self.view_directions(pixels), index)

    def view_directions(self, pixels: Tensor) -> Tensor:
        """Unit viewing directions in air, in the world frame: (*B, 2) -> (*B, 3)."""
        xy = self.intrinsics.plane_from_pixels(pixels)
        in_cam = torch.nn.functional.normalize(torch.cat((xy, torch.ones_like(xy[..., :1])), dim=-1), dim=-1)
        return (self.cam_from_world_rotation.mT @ in_cam[..., None])[..., 0]
