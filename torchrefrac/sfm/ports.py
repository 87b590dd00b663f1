"""Poses of housed cameras: by the pinhole that fits the rays in the water best, from which the adjustment with the
exact rays of the port goes on (as Refractive COLMAP does: She, Seegräber, Nakath, Köser, IROS 2024).

Behind a flat port every pixel has one ray in the water, in the camera's frame. All of them nearly meet in one point: it
takes the place of the centre, and where a ray is at the distance at which things are seen that of the pixel. Rays that
miss that point by millimetres are off by parts of a pixel there.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Rigid
from torchrefrac.minimal import triangulate
from torchrefrac.scene import Cameras, Capture, Interfaces
from torchrefrac.sfm.pinhole import PinholeInitializer
from torchrefrac.sfm.pose import OneByOne, PairPose, Pixels, Pose, Resection, cameras_of, meet
from torchrefrac.sfm.rules import SfmOptions

FAR = 60.0
"""Times the way through air and glass, of what is seen before anything is known of it."""
GRID = 9
"""Rays across an image that say where they nearly meet."""


@dataclass(frozen=True, eq=False)
class ApparentPinholes:
    """Of housed cameras, whose ports are `interfaces`; camera and interface: rows of the tables, of each image."""

    housed: Cameras
    interfaces: Interfaces
    camera: Int[Tensor, " m"]
    interface: Int[Tensor, " m"]

    @cached_property
    def cameras(self) -> Cameras:
        """The pinholes: without distortion, and with a focal length that is larger by the index ratio."""
        focal = self.interfaces.index_ratio[0] * self.housed.focal
        none = torch.zeros_like(self.housed.distortion)
        return replace(self.housed.exact(), focal=focal, distortion=none, models=())

    @cached_property
    def far(self) -> Float[Tensor, ""]:
        """The distance at which things are taken to be."""
        return FAR * (self.interfaces.thickness.sum(dim=-1) - self.interfaces.offset).max()

    def pixels(self, image: int, pixels: Float[Tensor, "k 2"]) -> Float[Tensor, "k 2"]:
        """Where the pinhole of an image sees what its pixels see."""
        origins, directions, _ = self._each[image].cast_rays(pixels)
        seen = origins + self.far * directions - self._middle[image]
        return self.cameras.of_views(self.camera[image]).pixels_from_plane(seen[:, :2] / seen[:, 2:])

    def centers(
        self, images: tuple[int, ...], rotation: Float[Tensor, "k 3 3"], pinholes: Float[Tensor, "k 3"]
    ) -> Float[Tensor, "k 3"]:
        """Centres of the cameras of some images, cam_from_world `rotation`, whose pinholes stand there."""
        return pinholes - (rotation.mT @ self._middle[list(images), :, None])[..., 0]

    @cached_property
    def _each(self) -> RefractiveCamera:
        """All cameras, each in its own frame."""
        at, rows = Rigid.identity(len(self.camera)), torch.arange(len(self.camera))
        intrinsics = self.housed.of_views(self.camera)
        interface = self.interfaces.of_views(self.interface)
        return RefractiveCamera(intrinsics, at.rotation, at.center, interface, check=False)[rows]

    @cached_property
    def _middle(self) -> Float[Tensor, "m 3"]:
        """The point that the rays of each image nearly meet in, in the frame of its camera."""
        sizes = self.housed.focal.new_tensor(self.housed.sizes)[self.camera]
        steps = (torch.arange(GRID, dtype=sizes.dtype) + 0.5) / GRID
        origins, directions, _ = self._each[:, None].cast_rays(torch.cartesian_prod(steps, steps) * sizes[:, None])
        return triangulate(origins, directions)[0]


@dataclass(frozen=True)
class PortInitializer(OneByOne):
    """Pinhole poses of the apparent pixels. Nothing but the port tells the scale, and that weakly: the first pair is
    put where it sees things FAR times farther than the water."""

    capture: Capture
    index_ratio: float
    options: SfmOptions

    def relative(self, images: tuple[int, int], pixels: Pixels, generator: torch.Generator) -> PairPose | None:
        first, second = (self._apparent.pixels(image, at) for image, at in zip(images, pixels, strict=True))
        found = self._pinholes.relative(images, (first, second), generator)
        if found is None or found.rotation is None or found.center is None:
            return found
        intrinsics, pose = self._pinholes.capture.intrinsics_of(list(images)), Rigid(found.rotation, found.center)
        both = torch.stack((first, second), dim=1)[found.inliers]
        points, _, _ = meet(cameras_of(intrinsics, pose, found.center.new_ones(())), both)
        away, middle = (points[:, None] - found.center).norm(dim=-1), found.center[:1]
        scale = self._apparent.far / away.median() if len(both) else 1.0
        center = self._apparent.centers(images, found.rotation, middle + scale * (found.center - middle))
        return replace(found, center=center, straight=None)

    def absolute(self, image: Resection, generator: torch.Generator) -> Pose | None:
        number = image.image
        apparent, at = self._pinholes.capture.intrinsics_of(number), self._apparent.pixels(number, image.pixels)
        found = self._pinholes.absolute(image._replace(intrinsics=apparent, pixels=at), generator)
        if found is None:
            return None
        return replace(found, center=self._apparent.centers((number,), found.rotation[None], found.center[None])[0])

    @cached_property
    def _apparent(self) -> ApparentPinholes:
        capture = self.capture
        ports = capture.interfaces.with_index_ratio(self.index_ratio)
        return ApparentPinholes(capture.cameras, ports, capture.camera, capture.interface)

    @cached_property
    def _pinholes(self) -> PinholeInitializer:
        air = self.capture.interfaces.with_index_ratio(1.0)
        return PinholeInitializer(replace(self.capture, cameras=self._apparent.cameras, interfaces=air), self.options)
