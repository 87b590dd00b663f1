"""Poses of housed cameras: by the pinhole that fits the rays in the water best, from which the adjustment with the
exact rays of the port goes on (as Refractive COLMAP does: She, Seegräber, Nakath, Köser, IROS 2024).

Behind a flat port every pixel has one ray in the water, in the camera's frame. All of them nearly meet in one point: it
takes the place of the centre, and where a ray is at the distance at which things are seen that of the pixel. Rays that
miss that point by millimetres are off by parts of a pixel there.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Rigid
from torchrefrac.minimal import triangulate
from torchrefrac.scene import Cameras, Capture, Interfaces
from torchrefrac.sfm.pinhole import PinholeInitializer
from torchrefrac.sfm.pose import PairPose, Pixels, Pose, cameras_of, meet
from torchrefrac.sfm.rules import SfmOptions

FAR = 60.0
"""Times the way through air and glass, of what is seen before anything is known of it."""
GRID = 9
"""Rays across an image that say where they nearly meet."""


@dataclass(frozen=True)
class PortInitializer:
    """Pinhole poses of the apparent pixels. Nothing but the port tells the scale, and that weakly: the first pair is
    put where it sees things FAR times farther than the water."""

    capture: Capture
    index_ratio: float
    options: SfmOptions

    def relative(self, images: tuple[int, int], pixels: Pixels, generator: torch.Generator) -> PairPose | None:
        first, second = (self._apparent(image, at) for image, at in zip(images, pixels, strict=True))
        found = self._pinholes.relative(images, (first, second), generator)
        if found is None or found.rotation is None or found.center is None:
            return found
        intrinsics = self._pinholes.capture.intrinsics_of(list(images))
        pose = Rigid(found.rotation, found.center)
        both = torch.stack((first, second), dim=1)[found.inliers]
        points, _, _ = meet(cameras_of(intrinsics, pose, found.center.new_ones(())), both)
        away = (points[:, None] - found.center).norm(dim=-1).median()
        scale = self._far / away if len(both) else 1.0
        middle = found.center[:1]
        center = middle + scale * (found.center - middle)
        return replace(found, center=self._behind_port(images, found.rotation, center), straight=None)

    def absolute(
        self,
        image: int,
        intrinsics: Intrinsics,
        pixels: Float[Tensor, "k 2"],
        points: Float[Tensor, "k 3"],
        generator: torch.Generator,
    ) -> Pose | None:
        apparent = self._pinholes.capture.intrinsics_of(image)
        found = self._pinholes.absolute(image, apparent, self._apparent(image, pixels), points, generator)
        if found is None:
            return None
        center = self._behind_port((image,), found.rotation[None], found.center[None])[0]
        return replace(found, center=center)

    def _apparent(self, image: int, pixels: Float[Tensor, "k 2"]) -> Float[Tensor, "k 2"]:
        """Where the pinhole of an image sees what its pixels see."""
        origins, directions, _ = self._cameras[image].cast_rays(pixels)
        seen = origins + self._far * directions - self._middle[image]
        return self._pinholes.capture.intrinsics_of(image).pixels_from_plane(seen[:, :2] / seen[:, 2:])

    def _behind_port(
        self, images: tuple[int, ...], rotation: Float[Tensor, "k 3 3"], apparent: Float[Tensor, "k 3"]
    ) -> Float[Tensor, "k 3"]:
        """Centres of cameras whose rays nearly meet in `apparent`."""
        return apparent - (rotation.mT @ self._middle[list(images), :, None])[..., 0]

    @cached_property
    def _cameras(self) -> RefractiveCamera:
        """All photographs, each in its own frame."""
        capture = self.capture
        at = Rigid.identity(len(capture))
        interface = capture.interfaces.with_index_ratio(self.index_ratio).of_views(capture.interface)
        intrinsics = capture.cameras.of_views(capture.camera)
        return RefractiveCamera(intrinsics, at.rotation, at.center, interface, check=False)[torch.arange(len(capture))]

    @cached_property
    def _middle(self) -> Float[Tensor, "m 3"]:
        """The point that the rays of each image nearly meet in, in the frame of its camera."""
        sizes = torch.tensor([self.capture.cameras.sizes[i] for i in self.capture.camera.tolist()], dtype=torch.float64)
        steps = (torch.arange(GRID, dtype=torch.float64) + 0.5) / GRID
        grid = torch.cartesian_prod(steps, steps)
        origins, directions, _ = self._cameras[:, None].cast_rays(grid * sizes[:, None])
        return triangulate(origins, directions)[0]

    @cached_property
    def _far(self) -> Float[Tensor, ""]:
        """The distance at which things are taken to be."""
        interfaces = self.capture.interfaces
        return FAR * (interfaces.thickness.sum(dim=-1) - interfaces.offset).max()

    @cached_property
    def _pinholes(self) -> PinholeInitializer:
        """Of the apparent cameras: without distortion, and with a focal length that is larger by the index ratio."""
        cameras: Cameras = self.capture.cameras
        apparent = replace(
            cameras.exact(),
            focal=self.index_ratio * cameras.focal,
            distortion=torch.zeros_like(cameras.distortion),
            models=(),
        )
        air: Interfaces = self.capture.interfaces.with_index_ratio(1.0)
        return PinholeInitializer(replace(self.capture, cameras=apparent, interfaces=air), self.options)
