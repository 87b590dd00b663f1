"""A camera that looks through flat layers."""

from dataclasses import InitVar, dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.camera.jacobians import ProjectionJacobians, project_with_jacobians
from torchrefrac.camera.projection import project
from torchrefrac.checks import (
    at_least_single,
    holds_everywhere,
    require,
    require_broadcasting,
    require_ending,
    require_floating,
    require_rotation,
    unwrapped,
)
from torchrefrac.geometry import Plane, rotate
from torchrefrac.geometry.triples import Vectors
from torchrefrac.numerics import pick
from torchrefrac.refraction import FlatInterface, lift_points, refract_rays

Points = Real[Tensor, "*#batch 3"]  # whole numbers are taken in the dtype of the camera
Pixels = Real[Tensor, "*#batch 2"]


@dataclass(frozen=True, eq=False)
class RefractiveCamera:
    """A batch of cameras that look at points beyond `interface`, or on their own side of it.

    cam_from_world_rotation: camera x right, y down, z forward; center_in_world: world z up, in the length unit of the
    interface and the points. A `FlatInterface` is by default a water surface at z = 0. The batch broadcasts against the
    leading dimensions of what is projected: give points (N, 3) to one camera, or index a batch of M cameras as
    `camera[:, None]` for an (M, N) grid.

    The intrinsics take the dtype of the pose. Raises ValueError for shapes that do not fit, values that are not finite,
    a rotation that is none (to three digits), and a camera that does not stand on its side of the interface.
    check=False leaves out the look at values, which waits for a GPU: steps of an optimiser may put a camera under
    water; what it sees is then not valid.
    """

    intrinsics: Intrinsics
    cam_from_world_rotation: Float[Tensor, "*#batch 3 3"]
    center_in_world: Vectors
    interface: FlatInterface
    check: InitVar[bool] = True

    def __post_init__(self, check: bool) -> None:
        for name, ending in (("cam_from_world_rotation", (3, 3)), ("center_in_world", (3,))):
            require_ending(getattr(self, name), name, ending)
            require_floating(getattr(self, name), name)
        if check:
            require_rotation(self.cam_from_world_rotation, "cam_from_world_rotation")
        for name in ("cam_from_world_rotation", "center_in_world"):
            object.__setattr__(self, name, at_least_single(getattr(self, name)))
        dtype = torch.promote_types(self.cam_from_world_rotation.dtype, self.center_in_world.dtype)
        if self.intrinsics.focal.dtype != dtype:
            object.__setattr__(self, "intrinsics", self.intrinsics.to(dtype=dtype))
        _ = self.shape
        if check and not torch.compiler.is_compiling():
            require(self.center_in_world, "center_in_world")
            self._require_on_its_side()

    def __getitem__(self, index: Any) -> "RefractiveCamera":
        """Index the batch dimensions as one indexes a tensor: `camera[3]`, `camera[:, None]`.

        What is not batched, but shared by all cameras (intrinsics, interface), stays shared.
        """
        batch = self.shape
        if not batch:
            _ = torch.zeros(())[index]  # a single camera has no numbers: IndexError
        return RefractiveCamera(
            self.intrinsics.indexed(index, batch),
            pick(self.cam_from_world_rotation, index, batch, 2),
            pick(self.center_in_world, index, batch, 1),
            self.interface.indexed(index, batch),
            check=False,
        )

    @property
    def shape(self) -> torch.Size:
        """The batch shape *B."""
        return require_broadcasting(
            cam_from_world_rotation=self.cam_from_world_rotation.shape[:-2],
            center_in_world=self.center_in_world.shape[:-1],
            intrinsics=self.intrinsics.shape,
            interface=self.interface.shape,
        )

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "RefractiveCamera":
        """The same in another dtype or on another device."""
        return RefractiveCamera(
            self.intrinsics.to(dtype=dtype, device=device),
            self.cam_from_world_rotation.to(dtype=dtype, device=device),
            self.center_in_world.to(dtype=dtype, device=device),
            self.interface.to(dtype=dtype, device=device),
            check=False,
        )

    def project(
        self, points_in_world: Points, *, inside_image: bool = False, beyond_only: bool = False
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of world points, and a mask of what the camera can see.

        Exact (Chang & Chen, Eq. 21, for one water surface); differentiable in the points, the pose, the intrinsics and
        all of the interface. Points on the camera's side are seen straight: land and water in one call. Not valid: a
        point behind the camera, a camera on the wrong side of its interface; with `inside_image` what lies outside the
        image; with `beyond_only` points on the camera's side. Finite points have finite pixels, valid or not.
        """
        pixels, valid, beyond = project(*self._looking_at(points_in_world))
        if beyond_only:
            valid = valid & beyond
        if inside_image:
            valid = valid & self.intrinsics.contains(pixels)
        return pixels, valid

    def project_with_jacobians(
        self, points_in_world: Points
    ) -> tuple[Float[Tensor, "*batch 2"], ProjectionJacobians, Bool[Tensor, "*batch"]]:
        """Pixels, their closed-form derivatives and the mask of `project`."""
        return project_with_jacobians(*self._looking_at(points_in_world))

    def cast_rays(
        self, pixels: Pixels
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """The rays in the last medium that pixels see, in the world frame.

        Returns where they enter it, unit directions there, and a mask: False for rays that do not
        meet the interface or are totally reflected, which are returned straight, from the centre.
        """
        origins, _, directions, valid = self.follow_rays(pixels)
        return origins, directions, valid

    def follow_rays(
        self, pixels: Pixels
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """`cast_rays` with both parts of each ray: origins, unit directions before and after, mask; pixels as there."""
        pixels = self._checked(pixels, "pixels", 2)
        in_cam = self._directions_in_cam(pixels)
        world_from_cam = self.cam_from_world_rotation.mT
        before = rotate(world_from_cam, in_cam)
        if not self.interface.moves_with_camera:
            origins, after, valid = refract_rays(self.center_in_world, before, self.interface)
            return origins, before, after, valid
        origins, after, valid = refract_rays(torch.zeros_like(self.center_in_world), in_cam, self.interface)
        return rotate(world_from_cam, origins) + self.center_in_world, before, rotate(world_from_cam, after), valid

    def rays(
        self, height: int | None = None, width: int | None = None
    ) -> tuple[
        Float[Tensor, "*batch rows columns 3"],
        Float[Tensor, "*batch rows columns 3"],
        Bool[Tensor, "*batch rows columns"],
    ]:
        """`cast_rays` for a whole image: origins, unit directions and mask.

        The grid covers the image with pixels of equal size; by default it is the image's own.
        """
        return self[..., None, None].cast_rays(self.intrinsics.pixel_grid(height, width))

    def view_directions(self, pixels: Pixels) -> Float[Tensor, "*batch 3"]:
        """Unit viewing directions of pixels in the camera's medium, in the world frame."""
        pixels = self._checked(pixels, "pixels", 2)
        return rotate(self.cam_from_world_rotation.mT, self._directions_in_cam(pixels))

    def as_pinhole(self) -> "RefractiveCamera":
        """The same camera without an interface: what every ordinary reconstruction takes it for."""
        center = self.center_in_world.expand((*self.shape, 3))
        return replace(self, center_in_world=center, interface=FlatInterface(1.0), check=False)

    def apparent_points(self, points_in_world: Points) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Where points appear to be, in the world frame: lifted along the normal; and the mask."""
        offset, valid = self._offsets(points_in_world)
        if self.interface.moves_with_camera:
            offset = rotate(self.cam_from_world_rotation.mT, offset)
        return self.center_in_world + offset, valid

    def apparent_depth(self, points_in_world: Points) -> tuple[Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
        """How far below the first surface points appear to be, negative on the camera's side; and the mask."""
        apparent, valid = self.apparent_points(points_in_world)
        return -self.plane_in_world().signed_distance(apparent), valid

    def incidence_angle(self, points_in_world: Points) -> tuple[Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
        """Angle (radians) between the ray to each point in the camera's medium and the normal; and the mask."""
        offset, valid = self._offsets(points_in_world)
        normal = self.interface.plane.normal_like(offset)
        across = torch.linalg.cross(normal.expand_as(offset), offset, dim=-1).norm(dim=-1)
        return torch.atan2(across, -(normal * offset).sum(dim=-1)), valid

    def refraction_shift(self, points_in_world: Points) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """By how many pixels refraction moves the image of each point; and where both images are valid."""
        bent, valid = self.project(points_in_world)
        straight, visible = self.as_pinhole().project(points_in_world)
        return bent - straight, valid & visible

    def plane_in_world(self) -> Plane:
        """The first surface in the world frame."""
        if not self.interface.moves_with_camera:
            return self.interface.plane
        origin = -rotate(self.cam_from_world_rotation, self.center_in_world)
        return self.interface.plane.in_frame(self.cam_from_world_rotation.mT, origin)

    def _looking_at(
        self, points: Points
    ) -> tuple[Intrinsics, Float[Tensor, "*#batch 3 3"], Vectors, Vectors, FlatInterface]:
        """What the functions of a projection take."""
        points = self._checked(points, "points_in_world", 3)
        return self.intrinsics, self.cam_from_world_rotation, self.center_in_world, points, self.interface

    def _offsets(self, points: Points) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Apparent offsets in the interface's frame."""
        points, center = self._checked(points, "points_in_world", 3), self.center_in_world
        if self.interface.moves_with_camera:
            points = rotate(self.cam_from_world_rotation, points - center)
            center = torch.zeros_like(center)
        offset, valid = lift_points(center, points, self.interface)
        batch = torch.broadcast_shapes(self.shape, valid.shape)
        return offset.expand((*batch, 3)), valid.expand(batch)

    def _directions_in_cam(self, pixels: Pixels) -> Float[Tensor, "*batch 3"]:
        xy = self.intrinsics.plane_from_pixels(pixels)
        return torch.nn.functional.normalize(torch.cat((xy, torch.ones_like(xy[..., :1])), dim=-1), dim=-1)

    def _checked(
        self, value: Real[Tensor, "*batch n"], name: str, components: int
    ) -> Float[Tensor, "*batch {components}"]:
        """Of a shape that broadcasts against the cameras, in the dtype that holds both."""
        require_ending(value, name, (components,))
        require_broadcasting(**{name: value.shape[:-1], "camera": self.shape})
        pose = torch.promote_types(self.center_in_world.dtype, self.cam_from_world_rotation.dtype)
        return value.to(torch.promote_types(value.dtype, pose))

    def _require_on_its_side(self) -> None:
        moves = self.interface.moves_with_camera
        origin = torch.zeros_like(self.center_in_world) if moves else self.center_in_world
        height = self.interface.plane.signed_distance(origin)
        wrong = (height <= 0) & self.interface.refracts().to(height.device)
        if holds_everywhere(~wrong):
            return
        depth = abs(float(unwrapped(torch.where(wrong, height, 0.0)).min()))
        if moves:
            raise ValueError(
                f"interface.plane lies {depth:g} behind the camera, but must lie ahead, its normal towards it"
            )
        wanted = "on the side that its normal points to (above a water surface)"
        raise ValueError(f"center_in_world is {depth:g} behind the interface somewhere, but must be {wanted}")
