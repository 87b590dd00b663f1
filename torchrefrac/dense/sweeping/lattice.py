"""The pixels of a small copy of the reference that a sweep works on, and the copies of the others it looks into."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.sweeping.surface import REACH

NODE = 8  # lattice pixels from one exact projection to the next


class Lattice(NamedTuple):
    """Pixels of the reference's copy `level`: width x height of them, from column `left` and row `top` of the copy on.

    origin (2): the copy's corner in the image; radius: of the windows that are compared, without the middle.
    """

    level: int
    left: int
    top: int
    width: int
    height: int
    origin: Tensor
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

    def pixels(self, columns: Tensor, rows: Tensor) -> Tensor:
        """Image pixels (r, c, 2) of lattice columns (c) and rows (r), which need not be whole numbers."""
        y, x = torch.meshgrid(self.top + rows.to(self.origin), self.left + columns.to(self.origin), indexing="ij")
        return self.origin + 2**self.level * (torch.stack((x, y), dim=-1) + 0.5)

    def locate(self, pixels: Tensor) -> Tensor:
        """Lattice columns and rows (*B, 2) of image pixels (*B, 2)."""
        return (pixels - self.origin) / 2**self.level - 0.5 - pixels.new_tensor((self.left, self.top))

    def nodes(self) -> tuple[Tensor, Tensor, Callable[[Tensor], Tensor]]:
        """Columns (n) and rows (k), about `NODE` apart, from the first to the last; and what makes values (m, k, n, 2)
        there bilinearly to those of the whole lattice (m, height, width, 2)."""
        (columns, across), (rows, down) = _nodes(self.width), _nodes(self.height)

        def spread(values: Tensor) -> Tensor:
            return (down.to(values) @ values.movedim(-1, 1) @ across.to(values).T).movedim(1, -1)

        return columns, rows, spread

    def grey_of(self, scope: Scope) -> Tensor:
        """The reference's grey values (height, width), about zero."""
        copy = scope.atlas.copy(0, self.level)[self.top :, self.left :][: self.height, : self.width]
        return copy - copy.mean()


class Copies(NamedTuple):
    """The m other images' copies, on canvases as large as the largest.

    images (m, 1 or 2, h, w): grey about zero, and where there are masks 1 for what they allow. origin (m, 2), in image
    pixels; size (m, 2), without what the canvas adds; shrink: size of an image pixel; radius: of the windows.
    """

    images: Tensor
    origin: Tensor
    size: Tensor
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

    def sample(self, pixels: Tensor) -> tuple[Tensor, Tensor | None]:
        """Grey values (m, r, c) at image pixels (m, r, c, 2), and how far masks allow them, where there are masks."""
        scale = 2.0 / pixels.new_tensor((self.images.shape[-1], self.images.shape[-2]))
        shift = -self.origin * (self.shrink * scale) - 1.0
        grid = torch.addcmul(shift[:, None, None], pixels, self.shrink * scale)
        values = torch.nn.functional.grid_sample(self.images, grid, align_corners=False)
        return values[:, 0], values[:, 1] if values.shape[1] > 1 else None

    def holds_window(self, pixels: Tensor) -> Tensor:
        """Whether windows about as large as the reference's fit in around image pixels (m, r, c, 2): (m, r, c)."""
        middle = self.origin + 0.5 * self.size / self.shrink
        room = (0.5 * self.size - self.radius) / self.shrink
        fits = (pixels - middle[:, None, None]).abs_() < room[:, None, None]
        return fits[..., 0] & fits[..., 1]


def _nodes(count: int) -> tuple[Tensor, Tensor]:
    """Places (n) from 0 to count - 1, and the matrix (count, n) that interpolates between them."""
    n = max(math.ceil((count - 1) / NODE), 1) + 1
    nodes = torch.linspace(0.0, count - 1.0, n, dtype=torch.float64)
    apart = (torch.arange(count, dtype=torch.float64)[:, None] - nodes).abs() * ((n - 1) / max(count - 1, 1))
    return nodes, (1.0 - apart).clamp(min=0.0)


def _allowed(scope: Scope, image: int, level: int, shape: torch.Size) -> Tensor:
    """Which pixels (h, w) of a copy have their middles where the mask allows it."""
    y, x = torch.meshgrid(
        *(torch.arange(n, dtype=torch.float64, device=scope.device) + 0.5 for n in shape), indexing="ij"
    )
    pixels = scope.atlas.origin[image] + 2**level * torch.stack((x, y), dim=-1)
    return scope.is_allowed(torch.full(pixels.shape[:-1], image, device=scope.device), pixels)
