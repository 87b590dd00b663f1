"""Several images and their smaller copies on one sheet, so that one call samples windows in all of them.

Sampling is PyTorch's `grid_sample`, with its own derivative: kornia's `warp_affine` and `warp_perspective` do the same
for patches at a quarter of the speed (tools/bench/dense.py). kornia makes the smaller copies.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MARGIN = 2  # pixels between neighbours on the sheet, and around each, filled with its border


@dataclass(frozen=True)
class Atlas:
    """Images, or parts of them, in several sizes, each half of the one before, on one sheet.

    sheet: grey; offset: from a pixel of a copy (x, y) to its place on the sheet; origin: the part's corner in its
    image; size: width and height of each copy in its own pixels. A copy's pixels (COLMAP's convention) are those of the
    part divided by 2^level. mode: bilinear or bicubic.
    """

    sheet: Float[Tensor, "1 1 height width"]
    offset: Float[Tensor, "m levels 2"]
    origin: Float[Tensor, "m 2"]
    size: Float[Tensor, "m levels 2"]
    mode: str

    @classmethod
    def build(
        cls,
        images: Sequence[Float[Tensor, "_ _"]],
        levels: int,
        origin: Float[Tensor, "m 2"] | None = None,
        mode: str = "bilinear",
    ) -> "Atlas":
        """Of m grey parts, which may differ in size, with their corners. Differentiable in the images."""
        return cls.of_copies([pyramid(image, levels) for image in images], origin, mode)

    @classmethod
    def of_copies(
        cls,
        pyramids: Sequence[Sequence[Float[Tensor, "_ _"]]],
        origin: Float[Tensor, "m 2"] | None = None,
        mode: str = "bilinear",
    ) -> "Atlas":
        """Of the `pyramid` of each of m parts, with their corners."""
        copies = [copy for one in pyramids for copy in one]
        places, height, width = _shelves([(copy.shape[0], copy.shape[1]) for copy in copies])
        sheet = copies[0].new_zeros(height, width)
        for copy, (x, y) in zip(copies, places, strict=True):
            h, w = copy.shape
            padded = torch.nn.functional.pad(copy[None, None], (MARGIN,) * 4, mode="replicate")[0, 0]
            sheet[y : y + h + 2 * MARGIN, x : x + w + 2 * MARGIN] = padded
        shape, device = (len(pyramids), len(pyramids[0]), 2), sheet.device
        offset = torch.tensor([(x + MARGIN, y + MARGIN) for x, y in places], dtype=torch.float64, device=device)
        size = torch.tensor([(c.shape[1], c.shape[0]) for c in copies], dtype=torch.float64, device=device)
        if origin is None:
            origin = size.new_zeros(len(pyramids), 2)
        return cls(sheet[None, None], offset.view(shape), origin.to(size), size.view(shape), mode)

    @property
    def levels(self) -> int:
        return self.offset.shape[1]

    def level_of(self, scale: Float[Tensor, "*batch"]) -> Int[Tensor, "*batch"]:
        """The copies that show things about as large as an image that shows them at 1 / scale."""
        return torch.log2(scale.clamp(min=1.0)).round().long().clamp(max=self.levels - 1)

    def to(self, device: torch.device) -> "Atlas":
        """The same on another device."""
        sheet, offset, origin, size = (t.to(device) for t in (self.sheet, self.offset, self.origin, self.size))
        return Atlas(sheet, offset, origin, size, self.mode)

    def copy(self, image: int, level: int = 0) -> Float[Tensor, "h w"]:
        """The copy of an image's part."""
        (x, y), (width, height) = self.offset[image, level].long().tolist(), self.size[image, level].long().tolist()
        return self.sheet[0, 0, y : y + height, x : x + width]

    def contains(
        self, image: Int[Tensor, " p"], level: Int[Tensor, " p"], pixels: Float[Tensor, "p k 2"]
    ) -> Bool[Tensor, " p"]:
        """Whether all k pixels of an image lie in its copy `level`, half a pixel from the border."""
        low, high = (bound.to(pixels)[image, level][:, None] for bound in self._inner)
        return ((pixels > low) & (pixels < high)).flatten(1).all(dim=1)

    @cached_property
    def _inner(self) -> tuple[Float[Tensor, "m levels 2"], Float[Tensor, "m levels 2"]]:
        """The least and the greatest pixels of each copy that are half a pixel from its border."""
        stretch = 2.0 ** torch.arange(self.levels, device=self.size.device).to(self.size)[:, None]
        return self.origin[:, None] + 0.5 * stretch, self.origin[:, None] + (self.size - 0.5) * stretch

    def sample(
        self, image: Int[Tensor, " p"], level: Int[Tensor, " p"], pixels: Float[Tensor, "p k 2"]
    ) -> Float[Tensor, "p k"]:
        """Grey values at k pixels of each image, in its copy `level`.

        Differentiable in the pixels and in the images. Up to half a pixel of the copy beyond its border they are those
        of the border; farther out they mean nothing (see `contains`).
        """
        grid, _ = self.locate(image, level, pixels)
        return self._look_up(grid.to(self.sheet.dtype))

    def locate(
        self, image: Int[Tensor, " p"], level: Int[Tensor, " p"], pixels: Float[Tensor, "p k 2"]
    ) -> tuple[Float[Tensor, "p k 2"], Float[Tensor, "p 1 2"]]:
        """Places on the sheet of k pixels of each image, in its copy `level`, and their derivatives in the pixels.

        The sheet reaches from -1 to 1 either way. Places are affine in the pixels: what lies between pixels lies
        between their places.
        """
        height, width = self.sheet.shape[-2:]
        scale = pixels.new_tensor((2.0 / width, 2.0 / height))
        shrink = self._shrink(level, pixels)
        shift = (self.offset[image, level].to(pixels) - self.origin[image].to(pixels) * shrink) * scale - 1.0
        per_pixel = (shrink * scale)[:, None]
        return torch.addcmul(shift[:, None], pixels, per_pixel), per_pixel

    def sample_with_slopes(self, places: Float[Tensor, "p k 2"]) -> tuple[Float[Tensor, "p k"], Float[Tensor, "p k 2"]]:
        """Grey values at places on the sheet (see `locate`) and their derivatives there; without a graph."""
        places = places.detach().requires_grad_()
        with torch.enable_grad():
            values = self._look_up(places)
        slopes = torch.autograd.grad(values, places, torch.ones_like(values))[0]
        return values.detach(), slopes

    def _look_up(self, places: Float[Tensor, "p k 2"]) -> Float[Tensor, "p k"]:
        return torch.nn.functional.grid_sample(
            self.sheet, places[None], mode=self.mode, padding_mode="border", align_corners=False
        )[0, 0]

    def _shrink(self, level: Int[Tensor, " p"], like: Float[Tensor, "..."]) -> Float[Tensor, "p 1"]:
        return (0.5 ** level.to(like))[:, None]


def pyramid(image: Float[Tensor, "h w"], levels: int) -> list[Float[Tensor, "_ _"]]:
    """The image and its smaller copies; odd sizes first repeat their last row or column."""
    from kornia.geometry import transform  # noqa: PLC0415 - importing it takes seconds

    copies = [image[None, None]]
    for _ in range(levels - 1):
        h, w = copies[-1].shape[-2:]
        even = torch.nn.functional.pad(copies[-1], (0, w % 2, 0, h % 2), mode="replicate")
        copies.append(transform.pyrdown(even))
    return [copy[0, 0] for copy in copies]


def _shelves(sizes: Sequence[tuple[int, int]]) -> tuple[list[tuple[int, int]], int, int]:
    """Corners (x, y) of rectangles (h, w) with their margins, put side by side on shelves, the tallest first. Also
    height and width of the whole, which is about square."""
    padded = [(h + 2 * MARGIN, w + 2 * MARGIN) for h, w in sizes]
    width = max(int(sum(h * w for h, w in padded) ** 0.5), *(w for _, w in padded), 1)
    places: list[tuple[int, int]] = [(0, 0)] * len(padded)
    x = y = shelf = 0
    for i in sorted(range(len(padded)), key=lambda i: -padded[i][0]):
        h, w = padded[i]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        places[i] = (x, y)
        x, shelf = x + w, max(shelf, h)
    return places, y + shelf, width
