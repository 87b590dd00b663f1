"""A reference image cut into tiles, and of the other images what a tile can see: memory does not grow with them."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import Neighbourhood
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import Scope

Box = tuple[int, int, int, int]  # left, top, right, bottom in pixels
BORDER_SAMPLES, DEPTH_SAMPLES = 9, 7
OVERLAP = 2  # cells by which a tile reaches back into those before it, whose patches then begin its own


def scopes(neighbourhood: Neighbourhood, images: Images, options: DenseOptions) -> Iterator[Scope]:
    """The scopes of all tiles of the reference; one for the whole where it is small enough."""
    device, (height, width) = torch.device(options.device), images.size
    whole = max(width, height) <= options.max_tile
    for tile in [(0, 0, width, height)] if whole else tile_boxes(width, height, options):
        boxes = [tile] * len(neighbourhood.ids) if whole else _boxes(neighbourhood, tile, options)
        seen = torch.tensor([box[2] > box[0] and box[3] > box[1] for box in boxes])
        if int(seen.sum()) < 2:
            continue
        ids = neighbourhood.ids[seen]
        parts = [box for box, is_seen in zip(boxes, seen.tolist(), strict=True) if is_seen]
        greys = [
            images.grey(int(i))[top:bottom, left:right].to(device).float()
            for i, (left, top, right, bottom) in zip(ids, parts, strict=True)
        ]
        origin = torch.tensor([box[:2] for box in parts], dtype=torch.float64)
        yield Scope(
            ids=ids.to(device),
            cameras=neighbourhood.cameras[seen].to(device=device),
            atlas=Atlas.build(greys, options.levels, origin, options.interpolation),
            allowed=torch.stack([images.allowed(int(i)) for i in ids]).to(device) if images.has_masks else None,
            near=neighbourhood.near,
            far=neighbourhood.far,
            tile=tile,
            interest_points=images.interest_points,
            points=neighbourhood.points.to(device),
            pixels=neighbourhood.pixels.to(device),
        )


def tile_boxes(width: int, height: int, options: DenseOptions) -> Iterator[Box]:
    """Boxes of whole cells that cover the image."""
    step = max(options.max_tile // options.cell - OVERLAP, 1) * options.cell
    reach = OVERLAP * options.cell
    for top in range(0, height, step):
        for left in range(0, width, step):
            yield max(left - reach, 0), max(top - reach, 0), min(left + step, width), min(top + step, height)


def _boxes(neighbourhood: Neighbourhood, tile: Box, options: DenseOptions) -> list[Box]:
    """What each image shows of the tile, with room for windows in the smallest copies; empty: nothing."""
    cameras, (left, top, right, bottom) = neighbourhood.cameras, tile
    x, y = torch.linspace(left, right, BORDER_SAMPLES), torch.linspace(top, bottom, BORDER_SAMPLES)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2).double()
    distance = torch.linspace(neighbourhood.near, neighbourhood.far, DEPTH_SAMPLES, dtype=torch.float64)
    points = PixelRays.cast(cameras[0], pixels)[:, None].at(distance.expand(len(pixels), -1)).flatten(0, 1)
    at, valid = cameras[:, None].project(points)
    margin = options.window << (options.levels - 1)
    step = 1 << (options.levels - 1)
    width, height = cameras.intrinsics.width, cameras.intrinsics.height
    return [_box_of(p[v], margin, step, width, height) for p, v in zip(at, valid, strict=True)]


def _box_of(pixels: Float[Tensor, "k 2"], margin: int, step: int, width: int, height: int) -> Box:
    """Around pixels, on a lattice on which the copies' pixels fit those of the image."""
    if not len(pixels):
        return 0, 0, 0, 0
    low, high = pixels.amin(dim=0) - margin, pixels.amax(dim=0) + margin
    left, top = (max(int(v) // step * step, 0) for v in low)
    right, bottom = min(int(high[0]) + 1, width), min(int(high[1]) + 1, height)
    return (left, top, right, bottom) if right > left and bottom > top else (0, 0, 0, 0)
