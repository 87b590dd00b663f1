"""The pixels of a small copy of the reference that a sweep works on, and the copies of the others it looks into."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.sweeping.surface import REACH

NODE = 8  # lattice pixels from one exact projection to the next
Spread = Callable[[Float[Tensor, "m k n 2"]], Float[Tensor, "m height width 2"]]


class Lattice(NamedTuple):
    """Pixels of the reference's copy `level`: width x height of them, from column `left` and row `top` of the copy on.

    origin: the copy's corner in the image; radius: of the windows that are compared, without the middle.
    """

    level: int
    left: int
    top: int
    width: int
    height: int
    origin: Float[Tensor, "2"]
    radius: int

    @classmethod
    def of(cls, scope: Scope, options: DenseOptions) -> "Lattice":
        """All that the scope's tile needs, as far as the copy has it."""
        level, radius = min(options.sweep.level, scope.atlas.levels - 1), options.sweep.window // 2
        origin, size = scope.atlas.origin[0].double(), scope.atlas.size[0, level].long()
        corners = (torch.tensor(scope.tile, device=scope.device).view(2, 2) - origin) / 2**level
        first = (corners[0].floor().long() - radius - REACH).clamp(min=0)
        extent = (size.minimum(corners[1].ceil().long() + radius + REACH) - first).clamp(min=0)
        (left, top), (width, height) = first.tolist(), extent.tolist()
        return cls(level, left, top, width, height, origin, radius)

    def pixels(self, columns: Float[Tensor, " c"], rows: Float[Tensor, " r"]) -> Float[Tensor, "r c 2"]:
        """Image pixels of lattice columns and rows, which need not be whole numbers."""
        y, x = torch.meshgrid(self.top + rows.to(self.origin), self.left + columns.to(self.origin), indexing="ij")
        return self.origin + 2**self.level * (torch.stack((x, y), dim=-1) + 0.5)

    def locate(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Lattice columns and rows of image pixels."""
        return (pixels - self.origin) / 2**self.level - 0.5 - pixels.new_tensor((self.left, self.top))

    def nodes(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " k"], "Spread"]:
        """Columns and rows, about `NODE` apart, from the first to the last; and what makes values there bilinearly to
        those of the whole lattice."""
        (columns, across), (rows, down) = _nodes(self.width), _nodes(self.height)

        def spread(values: Float[Tensor, "m k n 2"]) -> Float[Tensor, "m height width 2"]:
            return (down.to(values) @ values.movedim(-1, 1) @ across.to(values).T).movedim(1, -1)

        return columns, rows, spread

    def grey_of(self, scope: Scope) -> Float[Tensor, "height width"]:
        """The reference's grey values, about zero."""
        copy = scope.atlas.copy(0, self.level)[self.top :, self.left :][: self.height, : self.width]
        return copy - copy.mean()


class Copies(NamedTuple):
    """The m other images' copies, on canvases as large as the largest.

    images: grey about zero, and where there are masks, beside it, 1 for what they allow; origin, in image pixels; size,
    without what the canvas adds; shrink: size of an image pixel; radius: of the windows.
    """

    images: Float[Tensor, "m layers h w"]
    origin: Float[Tensor, "m 2"]
    size: Float[Tensor, "m 2"]
    shrink: float
    radius: int

    @classmethod
    def of(cls, scope: Scope, count: int, lattice: Lattice) -> "Copies":
        """Of the first `count` images after the reference."""
        atlas, rows = scope.atlas, slice(1, 1 + count)
        size = atlas.size[rows, lattice.level]
        width, height = size.amax(dim=0).long().tolist()
        images = atlas.sheet.new_zeros(count, 1 if scope.allowed is None else 2, height, width)
        for image, canvas in enumerate(images, start=1):
            grey = scope.atlas.copy(image, lattice.level)
            canvas[0, : grey.shape[0], : grey.shape[1]] = grey - grey.mean()
            if scope.allowed is not None:
                canvas[1, : grey.shape[0], : grey.shape[1]] = _allowed(scope, image, lattice.level, grey.shape)
        like = images.dtype
        return cls(images, atlas.origin[rows].to(like), size.to(like), 0.5**lattice.level, lattice.radius)

    def sample(self, pixels: Float[Tensor, "m r c 2"]) -> tuple[Float[Tensor, "m r c"], Float[Tensor, "m r c"] | None]:
        """Grey values at image pixels, and how far masks allow them, where there are masks."""
        scale = 2.0 / pixels.new_tensor((self.images.shape[-1], self.images.shape[-2]))
        shift = -self.origin * (self.shrink * scale) - 1.0
        grid = torch.addcmul(shift[:, None, None], pixels, self.shrink * scale)
        values = torch.nn.functional.grid_sample(self.images, grid, align_corners=False)
        return values[:, 0], values[:, 1] if values.shape[1] > 1 else None

    def fits_window(self, pixels: Float[Tensor, "m r c 2"]) -> Bool[Tensor, "m r c"]:
        """Whether windows about as large as the reference's fit in around image pixels."""
        middle = self.origin + 0.5 * self.size / self.shrink
        room = (0.5 * self.size - self.radius) / self.shrink
        fits = (pixels - middle[:, None, None]).abs_() < room[:, None, None]
        return fits[..., 0] & fits[..., 1]


def _nodes(count: int) -> tuple[Float[Tensor, " n"], Float[Tensor, "{count} n"]]:
    """Places from 0 to count - 1, and the matrix that interpolates between them."""
    n = max(math.ceil((count - 1) / NODE), 1) + 1
    nodes = torch.linspace(0.0, count - 1.0, n, dtype=torch.float64)
    apart = (torch.arange(count, dtype=torch.float64)[:, None] - nodes).abs() * ((n - 1) / max(count - 1, 1))
    return nodes, (1.0 - apart).clamp(min=0.0)


def _allowed(scope: Scope, image: int, level: int, shape: torch.Size) -> Bool[Tensor, "h w"]:
    """Which pixels of a copy have their middles where the mask allows it."""
    y, x = torch.meshgrid(
        *(torch.arange(n, dtype=torch.float64, device=scope.device) + 0.5 for n in shape), indexing="ij"
    )
    pixels = scope.atlas.origin[image] + 2**level * torch.stack((x, y), dim=-1)
    return scope.is_allowed(torch.full(pixels.shape[:-1], image, device=scope.device), pixels)
