"""A reference image cut into tiles, and of the other images what a tile can see: memory does not grow with them."""

from collections.abc import Iterator

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import Neighbourhood
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import Scope

Box = tuple[int, int, int, int]  # left, top, right, bottom in pixels
BORDER_SAMPLES, DEPTH_SAMPLES = 9, 7
OVERLAP = 2  # cells by which a tile reaches back into those before it, whose patches then begin its own


def scopes(
    image: int, hood: Neighbourhood, cameras: RefractiveCamera, images: Images, options: DenseOptions
) -> Iterator[Scope]:
    """The scopes of all tiles of one image; one for the whole where it is small enough. cameras (m)."""
    ids, device = torch.cat((torch.tensor([image]), hood.others)), torch.device(options.device)
    height, width = images.size
    whole = max(width, height) <= options.max_tile
    for tile in [(0, 0, width, height)] if whole else _tiles(width, height, options):
        local = cameras[ids]
        boxes = [(0, 0, width, height)] * len(ids) if whole else _boxes(local, tile, hood, options)
        seen = torch.tensor([box[2] > box[0] and box[3] > box[1] for box in boxes])
        if int(seen.sum()) < 2:
            continue
        there, local = ids[seen], local[seen]
        parts = [box for box, is_seen in zip(boxes, seen.tolist(), strict=True) if is_seen]
        greys = [
            images.grey(int(i))[top:bottom, left:right].to(device).float()
            for i, (left, top, right, bottom) in zip(there, parts, strict=True)
        ]
        origin = torch.tensor([box[:2] for box in parts], dtype=torch.float64)
        yield Scope(
            ids=there.to(device),
            cameras=local.to(device=device),
            atlas=Atlas.build(greys, options.levels, origin, options.interpolation),
            allowed=torch.stack([images.allowed(int(i)) for i in there]).to(device) if images.has_masks else None,
            near=hood.near,
            far=hood.far,
            tile=tile,
            interest_points=images.interest_points,
        )


def _tiles(width: int, height: int, options: DenseOptions) -> Iterator[Box]:
    """Boxes of whole cells that cover the image."""
    step = max(options.max_tile // options.cell - OVERLAP, 1) * options.cell
    reach = OVERLAP * options.cell
    for top in range(0, height, step):
        for left in range(0, width, step):
            yield max(left - reach, 0), max(top - reach, 0), min(left + step, width), min(top + step, height)


def _boxes(cameras: RefractiveCamera, tile: Box, hood: Neighbourhood, options: DenseOptions) -> list[Box]:
    """What each image (1 + n) shows of the tile, with room for windows in the smallest copies; empty: nothing."""
    left, top, right, bottom = tile
    x, y = torch.linspace(left, right, BORDER_SAMPLES), torch.linspace(top, bottom, BORDER_SAMPLES)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2).double()
    distance = torch.linspace(hood.near, hood.far, DEPTH_SAMPLES, dtype=torch.float64)
    points = PixelRays.cast(cameras[0], pixels)[:, None].at(distance.expand(len(pixels), -1)).flatten(0, 1)
    at, valid = cameras[:, None].project(points)
    margin = options.window << (options.levels - 1)
    step = 1 << (options.levels - 1)
    width, height = cameras.intrinsics.width, cameras.intrinsics.height
    return [_box_of(p[v], margin, step, width, height) for p, v in zip(at, valid, strict=True)]


def _box_of(pixels: Tensor, margin: int, step: int, width: int, height: int) -> Box:
    """Around pixels (k, 2), on a lattice on which the copies' pixels fit those of the image."""
    if not len(pixels):
        return 0, 0, 0, 0
    low, high = pixels.amin(dim=0) - margin, pixels.amax(dim=0) + margin
    left, top = (max(int(v) // step * step, 0) for v in low)
    right, bottom = min(int(high[0]) + 1, width), min(int(high[1]) + 1, height)
    return (left, top, right, bottom) if right > left and bottom > top else (0, 0, 0, 0)
