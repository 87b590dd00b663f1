"""Photographs of water that ends somewhere: each pixel looks at the water or past it, and what it sees is made dense
with cameras that look through water, or straight."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from scipy.spatial import KDTree
from torch import Tensor

from torchrefrac.dense.images import photographs
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.store import Store
from torchrefrac.scene import Interfaces, Scene

BLOCK = 4  # pixels across of what is looked up at once

Where = Callable[[int], Bool[Tensor, "height width"]]


@dataclass(frozen=True, eq=False)
class Side:
    """Which pixels of an image of the scene look past the water, or which do not.

    below: points below its level; outside: those that lie outside the water.
    """

    scene: Scene
    below: Bool[Tensor, " n"]
    outside: Bool[Tensor, " n"]
    past_water: bool

    def __call__(self, image: int) -> Bool[Tensor, "height width"]:
        return _past_water(self.scene, image, self.below, self.outside) == self.past_water


@dataclass(frozen=True, eq=False)
class Medium:
    """The scene as it is seen in one medium, and which pixels of an image see it; None: all do."""

    scene: Scene
    where: Where | None = None


def media_of(scene: Scene) -> list[Medium]:
    """The scene under water (and above it), and what lies outside the water, if anything does.

    A pixel looks past the water where its extent is drawn in its photograph and says so, or where none is drawn if the
    nearest observed point below the water's level is seen straight.
    """
    outside = scene.outside_water()
    if not bool(outside.any()):
        return [Medium(scene)]
    below = scene.placed & ~scene.above_water()
    straight = replace(_of_points(scene, ~(below & ~outside)), interfaces=Interfaces.level(1.0))
    return [
        Medium(_of_points(scene, ~outside), Side(scene, below, outside, past_water=False)),
        Medium(straight, Side(scene, below, outside, past_water=True)),
    ]


@dataclass(frozen=True)
class PartOfStore:
    """The place of one medium in a store: its images are numbered from `first`."""

    store: Store
    first: int

    def load(self, image: int) -> Patches | None:
        return self.store.load(self.first + image)

    def save(self, image: int, patches: Patches) -> None:
        self.store.save(self.first + image, patches)

    def room(self, count: int, views: int) -> Patches:
        return self.store.room(count, views)


def _of_points(scene: Scene, wanted: Bool[Tensor, " n"]) -> Scene:
    """The scene without the observations of all other points, none of which is dry any more."""
    rows = wanted[scene.observations.point].nonzero()[:, 0]
    return replace(scene, dry=None, observations=scene.observations[rows], accepted=scene.accepted[rows])


def _past_water(
    scene: Scene, image: int, below: Bool[Tensor, " n"], outside: Bool[Tensor, " n"]
) -> Bool[Tensor, "height width"]:
    capture = photographs(scene)
    width, height = scene.cameras.sizes[int(scene.views.camera[image])]
    x, y = (torch.arange(0, size, BLOCK, dtype=torch.float64) + 0.5 * BLOCK for size in (width, height))
    pixels = torch.stack((x.expand(len(y), -1), y[:, None].expand(-1, len(x))), dim=-1)
    extent, seen = capture.water_extent, scene.observations
    if extent is not None and extent.in_images and extent.in_images[image] is not None:
        past = extent.outside(image, pixels)
    else:
        mine = seen[((seen.view == image) & below[seen.point]).nonzero()[:, 0]]
        past = torch.zeros(len(y), len(x), dtype=torch.bool)
        if len(mine):
            _, nearest = KDTree(mine.pixels.numpy()).query(pixels.flatten(0, 1).numpy())
            past = outside[mine.point][torch.as_tensor(nearest)].view(len(y), len(x))
    return past.repeat_interleave(BLOCK, dim=0).repeat_interleave(BLOCK, dim=1)[:height, :width]
