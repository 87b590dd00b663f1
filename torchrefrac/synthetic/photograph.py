"""One photograph of a stage: the light, and what the optics and the sensor make of it."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry.surfaces import by_component
from torchrefrac.parallel import side_by_side
from torchrefrac.synthetic.glass import glass_of
from torchrefrac.synthetic.options import CameraOptions, SensorOptions, SyntheticOptions, seeded
from torchrefrac.synthetic.sight import Scenery, Sight
from torchrefrac.synthetic.stage import Stage
from torchrefrac.synthetic.waves import Waves, reflectance

TILE_RAYS = 1 << 15  # so many that their tensors stay in the processor's cache
READY_BYTES = 1 << 29  # of rays that need not be undistorted again for every image
IDEAL = Intrinsics(1, 1, torch.ones(2).double(), torch.zeros(2).double(), torch.zeros(0).double())
"""Of a camera whose pixels are ideal image-plane coordinates."""


@dataclass(frozen=True, eq=False)
class Photographer:
    """Takes photographs of a stage through water, or glass and water, samples x samples rays a pixel.

    reflection: grey value of the sky that the water mirrors, 0 for a surface that mirrors nothing.
    """

    stage: Stage
    scenery: Scenery
    intrinsics: Intrinsics
    samples: int
    reflection: float = 0.0

    @classmethod
    def of(cls, stage: Stage, options: SyntheticOptions) -> "Photographer":
        """As the options say, with their one camera. Water behind glass has no extent."""
        waves = Waves.draw(options.waves, options.seed)
        stage = stage if options.at_surface else replace(stage, water_extent=())
        return cls(
            stage=stage,
            scenery=Scenery(stage.pieces, options.index_ratio, waves, stage.water_extent, glass_of(options)),
            intrinsics=_intrinsics(options.camera),
            samples=options.sensor.samples,
            reflection=options.reflection,
        )

    @classmethod
    def each(cls, stage: Stage, options: SyntheticOptions) -> "tuple[Photographer, ...]":
        """One for each camera of the options, which take the photographs in turn and hold their cameras turned."""
        only = cls.of(stage, options)
        if not options.cameras:
            return (only,)
        turns = torch.arange(len(stage.rotation)) % len(options.cameras)
        quarters = torch.tensor([camera.quarter_turns for camera in options.cameras])[turns]
        quarter = torch.tensor(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), dtype=torch.float64)
        turned = torch.stack([torch.linalg.matrix_power(quarter, int(count) % 4) for count in quarters])
        held = replace(only.stage, rotation=turned @ stage.rotation)
        return tuple(replace(only, stage=held, intrinsics=_intrinsics(camera)) for camera in options.cameras)

    def look(self, image: int, pixels: Float[Tensor, "n 2"]) -> Sight:
        """What camera number `image` sees at pixels."""
        return self._look(image, self.intrinsics.plane_from_pixels(pixels))

    def take(self, image: int) -> Float32[Tensor, "height width 3"]:
        """RGB from 0 to 255: the mean colour over each pixel.

        Pixels are divided evenly; rays are followed in double precision, tile by tile on as many threads as PyTorch
        has. The result does not depend on their number.
        """
        self.look(image, self.intrinsics.principal_point[None])  # surfaces prepare before several threads ask

        def expose(tile: int) -> Float32[Tensor, "n 3"]:
            colors = self._colors(self._look(image, self._plane(tile)))
            return colors.reshape(-1, self.samples**2, 3).mean(dim=1)

        tiles = side_by_side(expose, range(len(self._tiles)))
        return torch.cat(tiles).reshape(self.intrinsics.height, self.intrinsics.width, 3)

    @cached_property
    def _tiles(self) -> tuple[Int[Tensor, "_"], ...]:
        """Numbers of the pixels of each tile, in the order of the image."""
        return torch.arange(self.intrinsics.width * self.intrinsics.height).split(max(1, TILE_RAYS // self.samples**2))

    @cached_property
    def _ready(self) -> dict[int, Float[Tensor, "_ 2"]]:
        return {}

    def _plane(self, tile: int) -> Float[Tensor, "n 2"]:
        """Ideal image-plane coordinates of samples^2 places in each pixel; they serve all images."""
        if tile in self._ready:
            return self._ready[tile]
        numbers, s = self._tiles[tile], self.samples
        corner = torch.stack((numbers % self.intrinsics.width, numbers // self.intrinsics.width), dim=-1)
        within = (torch.arange(s, dtype=torch.float64) + 0.5) / s
        offset = torch.cartesian_prod(within, within).flip(-1) if s > 1 else within.expand(1, 2)
        plane = (corner[:, None] + offset - self.intrinsics.principal_point).flatten(0, 1) / self.intrinsics.focal
        if not bool((self.intrinsics.distortion == 0.0).all()):
            plane = self.intrinsics.plane_from_pixels((corner[:, None] + offset).flatten(0, 1))
        plane = by_component(plane)
        if self.intrinsics.width * self.intrinsics.height * s**2 * 2 * plane.element_size() <= READY_BYTES:
            self._ready[tile] = plane
        return plane

    def _look(self, image: int, plane: Float[Tensor, "n 2"]) -> Sight:
        rotation, center, glass = self.stage.rotation[image], self.stage.center[image], self.scenery.glass
        if glass is not None:
            return self.scenery.look_through_glass(RefractiveCamera(IDEAL, rotation, center, glass, check=False), plane)
        x, y = plane.unbind(dim=-1)
        directions = (rotation[:2].mT @ plane.mT + rotation[2][:, None]) / (x * x + y * y + 1.0).sqrt()
        return self.scenery.look(center, directions.mT, moment=image)

    def _colors(self, sight: Sight) -> Float32[Tensor, "n 3"]:
        """RGB from 0 to 255."""
        colors = torch.full((len(sight.piece), 3), self.stage.background)
        for index, piece in enumerate(self.stage.pieces):
            own = (sight.piece == index).nonzero()[:, 0]
            if len(own):
                colors[own] = piece.texture(sight.uv[own]) * self._light(sight.normal[own])
        if self.reflection > 0.0:
            share = torch.where(sight.in_water, reflectance(sight.cosine, self.scenery.index_ratio), 0.0).float()
            colors = colors + share[:, None] * (self.reflection - colors)
        return colors

    def _light(self, normal: Float[Tensor, "n 3"]) -> Float32[Tensor, "n 1"]:
        """By how much surfaces of unit normals shine."""
        towards = torch.nn.functional.normalize(torch.tensor(self.stage.towards_light, dtype=normal.dtype), dim=-1)
        light = self.stage.ambient + self.stage.direct * (normal @ towards).abs()
        return light[:, None].float()


def _intrinsics(camera: CameraOptions) -> Intrinsics:
    return Intrinsics.create(camera.width, camera.height, camera.focal, distortion=camera.distortion)


def develop(
    light: Float32[Tensor, "height width 3"], options: SensorOptions, seed: int, image: int
) -> UInt8[np.ndarray, "height width 3"]:
    """The photograph, RGB, of colours from 0 to 255.

    A Gaussian spot of the optics, Gaussian noise of each grey value, rounded. The noise depends on the seed and the
    number of the image alone, so that images may be made in any order.
    """
    if options.blur > 0.0:
        size = 2 * max(1, round(4.0 * options.blur)) + 1
        blurred = cv2.GaussianBlur(light.numpy(), (size, size), options.blur, borderType=cv2.BORDER_REFLECT_101)
        light = torch.from_numpy(blurred)
    if options.noise > 0.0:
        light = light + options.noise * torch.randn(light.shape, generator=seeded(seed, "noise", image))
    return light.round().clamp(0.0, 255.0).to(torch.uint8).numpy()
