"""A reference image cut into tiles, and of the other images what a tile can see: memory does not grow with them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchrefrac.dense.atlas import Atlas, pyramid
from torchrefrac.dense.images import Images
from torchrefrac.dense.matching.interest_points import InterestPoints
from torchrefrac.dense.neighbours import Neighbourhood
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.rays import PixelRays
from torchrefrac.numerics import device_of

Box = tuple[int, int, int, int]  # left, top, right, bottom in pixels
BORDER_SAMPLES, DEPTH_SAMPLES = 9, 7
OVERLAP = 2  # cells by which a tile reaches back into those before it, whose patches then begin its own


@dataclass(frozen=True)
class Scope(Neighbourhood):
    """The neighbourhood of a reference image with the pixels of a tile of it, and of what the others show of that.

    atlas: of the images, or of parts of them; allowed: pixels that no mask excludes, None: all; tile: left, top, right,
    bottom of the cells that are worked on, in pixels; interest_points: those of an image, given its id.
    """

    atlas: Atlas
    allowed: Bool[Tensor, "v height width"] | None
    tile: Box
    interest_points: Callable[[int], InterestPoints]

    @property
    def device(self) -> torch.device:
        return self.atlas.sheet.device

    @property
    def others(self) -> int:
        return len(self.ids) - 1

    def is_allowed(self, image: Int[Tensor, "*batch"], pixels: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
        """Whether pixels of local images are inside and not masked."""
        intrinsics = self.cameras.intrinsics
        if (sizes := intrinsics.sizes) is None:
            inside = intrinsics.contains(pixels)
        else:
            inside = ((pixels >= 0.0) & (pixels <= sizes[image])).all(dim=-1)
        if self.allowed is None:
            return inside
        column = pixels[..., 0].long().clamp(0, intrinsics.width - 1)
        row = pixels[..., 1].long().clamp(0, intrinsics.height - 1)
        return inside & self.allowed[image, row, column]

    def centers(self, cell: int) -> Float[Tensor, "rows columns 2"]:
        """Centres of the tile's cells; those cut off by the image's border are left out.

        Cell row i, column j of the image has its centre in the middle of a pixel, or between pixels where `cell` is
        even.
        """
        left, top, right, bottom = self.tile
        columns = torch.arange(left // cell, right // cell, dtype=torch.float64, device=self.device)
        rows = torch.arange(top // cell, bottom // cell, dtype=torch.float64, device=self.device)
        y, x = torch.meshgrid((rows + 0.5) * cell, (columns + 0.5) * cell, indexing="ij")
        return torch.stack((x, y), dim=-1)


def scopes(neighbourhood: Neighbourhood, images: Images, options: DenseOptions) -> Iterator[Scope]:
    """The scopes of all tiles of the reference; one for the whole where it is small enough."""
    device, (height, width) = device_of(options.device), images.size(int(neighbourhood.ids[0]))
    whole = max(width, height) <= options.max_tile
    for tile in [(0, 0, width, height)] if whole else tile_boxes(width, height, options):
        boxes = _whole(neighbourhood, images) if whole else _boxes(neighbourhood, images, tile, options)
        seen = torch.tensor([box[2] > box[0] and box[3] > box[1] for box in boxes])
        if int(seen.sum()) < 2:
            continue
        ids = neighbourhood.ids[seen]
        parts = [box for box, is_seen in zip(boxes, seen.tolist(), strict=True) if is_seen]
        if whole:
            pyramids = [images.copies(i, options.levels) for i in ids.tolist()]
        else:
            pyramids = [
                pyramid(images.grey(i)[top:bottom, left:right].float(), options.levels)
                for i, (left, top, right, bottom) in zip(ids.tolist(), parts, strict=True)
            ]
        origin = torch.tensor([box[:2] for box in parts], dtype=torch.float64)
        yield Scope(
            ids=ids.to(device),
            cameras=neighbourhood.cameras[seen].to(device=device),
            near=neighbourhood.near,
            far=neighbourhood.far,
            points=neighbourhood.points.to(device),
            pixels=neighbourhood.pixels.to(device),
            atlas=Atlas.of_copies(pyramids, origin, options.interpolation).to(device),
            allowed=_stacked([images.allowed(int(i)) for i in ids]).to(device) if images.has_masks else None,
            tile=tile,
            interest_points=images.interest_points,
        )


def tile_boxes(width: int, height: int, options: DenseOptions) -> Iterator[Box]:
    """Boxes of whole cells that cover the image."""
    step = max(options.max_tile // options.cell - OVERLAP, 1) * options.cell
    reach = OVERLAP * options.cell
    for top in range(0, height, step):
        for left in range(0, width, step):
            yield max(left - reach, 0), max(top - reach, 0), min(left + step, width), min(top + step, height)


def _whole(neighbourhood: Neighbourhood, images: Images) -> list[Box]:
    """All of each image."""
    sizes = (images.size(i) for i in neighbourhood.ids.tolist())
    return [(0, 0, width, height) for height, width in sizes]


def _stacked(masks: Sequence[Bool[Tensor, "_ _"]]) -> Bool[Tensor, "v height width"]:
    """Masks as one table, where nothing is allowed beyond an image that is smaller than others."""
    height, width = (max(mask.shape[axis] for mask in masks) for axis in (0, 1))
    return torch.stack([pad(mask, (0, width - mask.shape[1], 0, height - mask.shape[0])) for mask in masks])


def _boxes(neighbourhood: Neighbourhood, images: Images, tile: Box, options: DenseOptions) -> list[Box]:
    """What each image shows of the tile, with room for windows in the smallest copies; empty: nothing."""
    cameras, (left, top, right, bottom) = neighbourhood.cameras, tile
    x, y = torch.linspace(left, right, BORDER_SAMPLES), torch.linspace(top, bottom, BORDER_SAMPLES)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2).double()
    distance = torch.linspace(neighbourhood.near, neighbourhood.far, DEPTH_SAMPLES, dtype=torch.float64)
    points = PixelRays.cast(cameras[0], pixels)[:, None].at(distance.expand(len(pixels), -1)).flatten(0, 1)
    at, valid = cameras[:, None].project(points)
    margin = options.window << (options.levels - 1)
    step = 1 << (options.levels - 1)
    sizes = [images.size(i) for i in neighbourhood.ids.tolist()]
    return [_box_of(p[v], margin, step, w, h) for p, v, (h, w) in zip(at, valid, sizes, strict=True)]


def _box_of(pixels: Float[Tensor, "k 2"], margin: int, step: int, width: int, height: int) -> Box:
    """Around pixels, on a lattice on which the copies' pixels fit those of the image."""
    if not len(pixels):
        return 0, 0, 0, 0
    low, high = pixels.amin(dim=0) - margin, pixels.amax(dim=0) + margin
    left, top = (max(int(v) // step * step, 0) for v in low)
    right, bottom = min(int(high[0]) + 1, width), min(int(high[1]) + 1, height)
    return (left, top, right, bottom) if right > left and bottom > top else (0, 0, 0, 0)
