"""The photographs of a capture and their masks, read when they are needed."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchrefrac.dense.atlas import pyramid
from torchrefrac.dense.matching.interest_points import InterestPoints, detect_interest_points
from torchrefrac.files.masks import Masks
from torchrefrac.files.photographs import read_color, read_grey
from torchrefrac.scene import Capture, CaptureError, Scene

PART, BESIDE = 2048, 32  # pixels across of what is searched for interest points at once, and that it looks beyond


class Images:
    """Grey and coloured pixels as 8-bit tensors, and which of them may be used (`Masks`).

    Of the grey images, and of their smaller copies, the last few are remembered. where: of each image, which pixels are
    meant at all; by default all.
    """

    def __init__(
        self,
        capture: Capture,
        remembered: int = 24,
        where: Callable[[int], Bool[Tensor, "height width"]] | None = None,
    ) -> None:
        self.capture, self._remembered, self._where = capture, remembered, where
        self._masks = Masks(capture)
        self.grey = lru_cache(maxsize=remembered)(self._grey)
        self.smaller = lru_cache(maxsize=remembered)(self._smaller)
        self.allowed = lru_cache(maxsize=remembered)(self._allowed)
        self.interest_points = lru_cache(maxsize=None)(self._interest_points)

    def __reduce__(self) -> tuple[type["Images"], tuple[Any, ...]]:
        """To another process they go without what is remembered."""
        return Images, (self.capture, self._remembered, self._where)

    def size(self, image: int) -> tuple[int, int]:
        """Height and width of an image."""
        width, height = self.capture.cameras.sizes[int(self.capture.camera[image])]
        return height, width

    @property
    def has_masks(self) -> bool:
        return self._where is not None or self._masks.hide_something

    def check(self) -> None:
        """Raise CaptureError for an image or a mask that is missing, cannot be read, or has another size."""
        for i in range(len(self.capture)):
            self.grey(i)
            self._masks.used(i)

    def colors(self, image: Int[Tensor, " n"], pixels: Float[Tensor, "n 2"]) -> UInt8[Tensor, "n 3"]:
        """RGB at pixels of images, each of which is read once."""
        colors, order = torch.zeros(len(pixels), 3, dtype=torch.uint8), image.argsort(stable=True)
        for each, rows in enumerate(order.split(image.bincount(minlength=1).tolist())):
            if len(rows):
                column, row = pixels[rows].long().unbind(dim=-1)
                picture = torch.from_numpy(read_color(self.capture.paths[each]))
                colors[rows] = picture[row, column].flip(-1)
        return colors

    def _grey(self, image: int) -> UInt8[Tensor, "height width"]:
        path = self.capture.paths[image]
        if not path.is_file():
            raise CaptureError(f"{path} does not exist any more, but the reconstruction has its pose; put it back")
        return self._sized(torch.from_numpy(read_grey(path)), path, self.size(image))

    def copies(self, image: int, levels: int) -> list[Float[Tensor, "_ _"]]:
        """The grey image and its smaller copies, `levels` together, as a `pyramid`."""
        return [self.grey(image).float(), *self.smaller(image, levels)]

    def _smaller(self, image: int, levels: int) -> list[Float[Tensor, "_ _"]]:
        return pyramid(self.grey(image).float(), levels)[1:]

    def _interest_points(self, image: int) -> InterestPoints:
        """One corner and one blob at most in every block of an image, found part by part."""
        grey = self.grey(image)
        height, width = self.size(image)
        found = []
        for top in range(0, height, PART):
            for left in range(0, width, PART):
                y, x = max(top - BESIDE, 0), max(left - BESIDE, 0)
                part = grey[y : top + PART + BESIDE, x : left + PART + BESIDE].float()
                points = detect_interest_points(part, per_cell=1)
                pixels = points.pixels + points.pixels.new_tensor((x, y))
                low, high = pixels.new_tensor((left, top)), pixels.new_tensor((left + PART, top + PART))
                mine = ((pixels >= low) & (pixels < high)).all(dim=-1)
                found.append((pixels[mine], points.kind[mine]))
        return InterestPoints(*(torch.cat(parts) for parts in zip(*found, strict=True)))

    def _allowed(self, image: int) -> Bool[Tensor, "height width"]:
        """Which pixels may be used."""
        used = self._masks.used(image)
        allowed = torch.ones(self.size(image), dtype=torch.bool) if used is None else used
        return allowed if self._where is None else allowed & self._where(image)

    @staticmethod
    def _sized(
        picture: UInt8[Tensor, "height width"], path: Path, size: tuple[int, int]
    ) -> UInt8[Tensor, "height width"]:
        if tuple(picture.shape) != size:
            found, wanted = (f"{width}x{height}" for height, width in (picture.shape, size))
            raise CaptureError(f"{path} is {found}, but the images are {wanted}; give it their size")
        return picture


def photographs(scene: Scene) -> Capture:
    """Those of the views, in their order. Raises CaptureError where the scene has none, or others."""
    if scene.capture is None:
        raise CaptureError("the scene has no photographs; give its capture as replace(scene, capture=...)")
    if scene.capture.names != scene.views.names:
        raise CaptureError("the photographs of the scene's capture are not those of its views, in the same order")
    return scene.capture
