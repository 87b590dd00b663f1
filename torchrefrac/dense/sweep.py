"""Where the surface of a whole image begins: every pixel is compared at many distances, as in a plane sweep.

The pixels of a small copy of the reference are put at one distance along their own rays after the other (Collins, CVPR
1996; along bent rays a distance is not a plane) and looked up in the other images. What agrees best in small windows is
made smooth: around each pixel, distance is fitted as a plane, which also tells the normal.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.refine import Planes
from torchrefrac.dense.scope import Scope

IMAGES = 6  # others to look into at most, the best ones
NODE = 8  # lattice pixels from one exact projection to the next; bilinear between them
PROBES = 9  # rays each way that tell how far the distances are to be apart
STEP = 1.0  # pixels of the copies that something moves between neighbouring distances
MOST = 0.75  # of what is seen moves by less than that
AHEAD = 32  # distances projected at once
FIT = 2  # lattice pixels from the middle of a fitted plane to its end
FIT_ROUNDS = 4
FIT_SCALE = 0.7  # distances, in steps, from which a neighbour counts less
FIT_LEAST = 8.0  # neighbours that must agree, of (2 FIT + 1)^2
RIDGE = 1.0  # on a fit's slopes, in neighbours
LOWEST = -1.0  # a score of what cannot be seen


class Lattice(NamedTuple):
    """Pixels of the reference's copy `level`: width x height of them, the first at column `left`, row `top` of the copy.

    origin: the copy's corner in the image; radius: of the windows that are compared.
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
        """As far as the scope's tile reaches, with what is needed around it."""
        level, radius = min(options.sweep.level, scope.atlas.levels - 1), options.sweep.window // 2
        origin = scope.atlas.origin[0].double()
        size = scope.atlas.size[0, level].long().tolist()
        tile = (torch.tensor(scope.tile).view(2, 2) - origin) / 2**level
        left, top = (tile[0].floor().long() - radius - FIT).clamp(min=0).tolist()
        right, bottom = (int(min(e, s)) for e, s in zip(tile[1].ceil() + radius + FIT, size, strict=True))
        return cls(level, left, top, max(right - left, 0), max(bottom - top, 0), origin, radius)

    def pixels(self, columns: Tensor, rows: Tensor) -> Tensor:
        """Image pixels (r, c, 2) of lattice columns (c) and rows (r), which need not be whole numbers."""
        y, x = torch.meshgrid(self.top + rows, self.left + columns, indexing="ij")
        return self.origin + 2**self.level * (torch.stack((x, y), dim=-1) + 0.5)

    def locate(self, pixels: Tensor) -> Tensor:
        """Lattice columns and rows (*B, 2) of image pixels (*B, 2)."""
        return (pixels - self.origin) / 2**self.level - 0.5 - pixels.new_tensor((self.left, self.top))


class Copies(NamedTuple):
    """Small copies of the m other images, as large as the largest: grey and, where there are masks, allowed (m, 1 or 2,
    h, w). scale, shift (m, 2): from image pixels to the part of each copy in which a window fits, -1 to 1; half, middle
    (m, 2): from there to `grid_sample`'s coordinates."""

    images: Tensor
    scale: Tensor
    shift: Tensor
    half: Tensor
    middle: Tensor

    @classmethod
    def of(cls, scope: Scope, images: int, lattice: Lattice) -> "Copies":
        atlas, level = scope.atlas, lattice.level
        rows = slice(1, 1 + images)
        origin, size = atlas.origin[rows], atlas.size[rows, level]
        width, height = size.amax(dim=0).long().tolist()
        stack = atlas.sheet.new_zeros(images, 1 if scope.allowed is None else 2, height, width)
        for copy, k in zip(stack, range(1, 1 + images), strict=True):
            grey = _copy_of(scope, k, level)
            copy[0, : grey.shape[0], : grey.shape[1]] = grey - grey.mean()
            if scope.allowed is not None:
                copy[1, : grey.shape[0], : grey.shape[1]] = _allowed(scope, k, level, grey.shape)
        room = (size / 2 - lattice.radius).clamp(min=1e-3)
        whole = size.new_tensor((width, height))
        scale = 0.5**level / room
        return cls(stack, scale, -origin * scale - size / 2 / room, 2.0 * room / whole, size / whole - 1.0)

    def at(self, local: Tensor) -> Tensor:
        """Values (m, 1 or 2, r, c) at places (m, r, c, 2), -1 to 1."""
        grid = torch.addcmul(*(t.to(local)[:, None, None] for t in (self.middle, self.half)), local)
        return torch.nn.functional.grid_sample(self.images, grid, align_corners=False)


def sweep(scope: Scope, options: DenseOptions) -> tuple[Tensor, Planes, Tensor]:
    """Beginnings for the cells of the tile, to be handed to `refine`.

    Returns the centres (k, 2) of those that have one, in the order of `Scope.centers`, their planes (k) and scores (k),
    a mean ZNCC. A cell has none where the images do not agree, or its neighbours do not.
    """
    lattice = Lattice.of(scope, options)
    images = min(IMAGES, scope.others)
    others = scope.cameras[1 : 1 + images]
    distances = _distances(scope, others, lattice, options)
    if len(distances) < 2 or min(lattice.width, lattice.height) <= 2 * lattice.radius:
        nothing = torch.zeros(0, 3, dtype=torch.float64)
        return nothing[:, :2], Planes(nothing, nothing), nothing[:, 0]
    step, score = _best(scope, others, lattice, distances, options)
    step[score < options.sweep.min_score] = math.nan
    return _planes(scope, lattice, distances, *_fit(step, score), options)


def _distances(scope: Scope, others: RefractiveCamera, lattice: Lattice, options: DenseOptions) -> Tensor:
    """Distances (n), between which what is seen moves by about `STEP` in the other images, or `planes` of them."""
    columns, rows = (torch.linspace(0.0, n - 1.0, PROBES, dtype=torch.float64) for n in (lattice.width, lattice.height))
    rays = PixelRays.cast(scope.cameras[0], lattice.pixels(columns, rows).view(-1, 2))
    fine = torch.linspace(scope.near, scope.far, 2 * options.sweep.planes, dtype=torch.float64)
    points = rays[None].at(fine[:, None].expand(-1, len(rays.origin)))
    pixels, seen = others[:, None, None].project(points, inside_image=True)
    seen = seen & _ahead(scope.cameras[0], rays, points)
    move = torch.where(seen[:, 1:] & seen[:, :-1], (pixels[:, 1:] - pixels[:, :-1]).norm(dim=-1), math.nan)
    move = move.transpose(0, 1).flatten(1).nanquantile(MOST, dim=1).nan_to_num(0.0) / 2**lattice.level
    path = torch.cat((move.new_zeros(1), move.cumsum(dim=0)))
    count = min(options.sweep.planes, math.ceil(float(path[-1]) / STEP) + 1)
    return _interpolate(torch.linspace(0.0, float(path[-1]), count, dtype=torch.float64), path, fine)


def _best(
    scope: Scope, others: RefractiveCamera, lattice: Lattice, distances: Tensor, options: DenseOptions
) -> tuple[Tensor, Tensor]:
    """Which distance is best (r, c), as a fraction between neighbours, and its score (r, c)."""
    size, shape = 2 * lattice.radius + 1, (lattice.height - 2 * lattice.radius, lattice.width - 2 * lattice.radius)
    reference = _copy_of(scope, 0, lattice.level)
    reference = reference[lattice.top :, lattice.left :][: lattice.height, : lattice.width]
    reference = reference - reference.mean()
    mean_f = _box(reference, size)
    floor = (options.noise / 2**lattice.level) ** 2
    var_f = (_box(reference.square(), size) - mean_f.square()).clamp(min=0.0)
    peaks = Peaks(shape, reference)
    copies = Copies.of(scope, len(others.center_in_world), lattice)
    fewest = max(1, min(options.min_views - 1, scope.others))
    for local in _places(scope, others, lattice, copies, distances, reference):
        values = copies.at(local)
        inner = local[:, lattice.radius :, lattice.radius :][:, : shape[0], : shape[1]]
        usable = inner.abs().amax(dim=-1) < 1.0
        g = values[:, 0]
        if values.shape[1] > 1:
            usable = usable & (_box(values[:, 1], size) > 0.999)
        mean_g, square_g, fg = _box(torch.stack((g, g * g, reference * g)), size)
        var_g = (square_g - mean_g * mean_g).clamp_(min=0.0)
        zncc = (fg - mean_f * mean_g) * ((var_f + floor) * (var_g + floor)).rsqrt_()
        peaks.add(_best_half(torch.where(usable, zncc, LOWEST), usable.sum(dim=0), fewest, options.views))
    step, score = peaks.finish()
    score[var_f.sqrt() < options.min_contrast / 2**lattice.level] = LOWEST
    around = (lattice.radius,) * 4
    return torch.nn.functional.pad(step, around), torch.nn.functional.pad(score, around, value=LOWEST)


def _places(scope, others, lattice, copies, distances, like):
    """Yields for each distance where the lattice is in the copies (m, r, c, 2); far away for what cannot be seen."""
    nodes, between = zip(*(_nodes(n) for n in (lattice.width, lattice.height)), strict=True)
    rays = PixelRays.cast(scope.cameras[0], lattice.pixels(*nodes))
    across, down = (b.to(like) for b in between)
    for some in distances.split(AHEAD):
        points = rays[None].at(some[:, None, None].expand(-1, *rays.origin.shape[:2]))
        pixels, seen = others[:, None, None, None].project(points)
        seen = seen & _ahead(scope.cameras[0], rays, points)
        local = torch.addcmul(copies.shift[:, None, None, None], pixels, copies.scale[:, None, None, None])
        local = torch.where(seen[..., None], local.clamp(-1e4, 1e4), 1e4).to(like)
        for one in local.unbind(dim=1):
            yield (down @ one.movedim(-1, 1) @ across.T).movedim(1, -1)


def _best_half(score: Tensor, usable: Tensor, fewest: int, most: int) -> Tensor:
    """Mean of the better half of each pixel's usable scores (m, r, c): an image in which it is hidden has no say."""
    rest = list(score.unbind(dim=0))
    count = ((usable + 1) // 2).clamp(fewest, max(most, fewest))
    total = torch.zeros_like(rest[0])
    for taken in range(min((len(rest) + 1) // 2 if len(rest) > fewest else fewest, max(most, fewest))):
        best = rest.pop()
        for i, other in enumerate(rest):
            best, rest[i] = torch.maximum(best, other), torch.minimum(best, other)
        total += torch.where(taken < count, best, 0.0)
    return torch.where(usable >= fewest, total / count, LOWEST)


class Peaks:
    """The highest local maximum of each pixel's scores, which come one distance after the other."""

    def __init__(self, shape: tuple[int, int], like: Tensor) -> None:
        self.before = self.last = like.new_full(shape, LOWEST)
        self.step, self.score = like.new_zeros(shape), like.new_full(shape, LOWEST)
        self.count = 0

    def add(self, score: Tensor) -> None:
        higher = (self.last >= self.before) & (self.last >= score) & (self.last > self.score)
        bend = (2.0 * self.last - self.before - score).clamp_(min=1e-6)
        offset = (0.5 * (score - self.before) / bend).clamp_(-0.5, 0.5)
        self.step = torch.where(higher, offset + (self.count - 1), self.step)
        self.score = torch.where(higher, self.last, self.score)
        self.before, self.last = self.last, score
        self.count += 1

    def finish(self) -> tuple[Tensor, Tensor]:
        self.add(torch.full_like(self.last, LOWEST))
        return self.step.clamp(0.0, self.count - 2.0), self.score


def _fit(step: Tensor, score: Tensor) -> tuple[Tensor, Tensor]:
    """Planes step = a + b x + c y around each lattice pixel, (a, b, c) as (3, r, c), and their scores (r, c).

    Outliers count less (Geman and McClure's loss), from the median on. A score is LOWEST where too few agree.
    """
    height, width = step.shape
    around, size = (FIT,) * 4, 2 * FIT + 1

    def neighbours(values: Tensor, fill: float) -> Tensor:
        padded = torch.nn.functional.pad(values[None, None], around, value=fill)
        return torch.nn.functional.unfold(padded, size)[0]

    values = neighbours(step, math.nan)
    present = values.isfinite()
    inner = torch.arange(size**2).view(size, size)[FIT - 1 : FIT + 2, FIT - 1 : FIT + 2].flatten()
    middle = values[inner].nanmedian(dim=0).values
    values = values.nan_to_num(0.0)
    offset = torch.arange(-FIT, FIT + 1).to(values)
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    moments = torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y)).flatten(1)
    plane = torch.stack((middle, torch.zeros_like(middle), torch.zeros_like(middle)))
    for _ in range(FIT_ROUNDS):
        off = values - moments[:3].T @ plane
        weight = torch.where(present, (1.0 + (off / FIT_SCALE).square()).square().reciprocal(), 0.0)
        total, sx, sy, sxx, sxy, syy = moments @ weight
        su, sxu, syu = moments[:3] @ (weight * values)
        per = total.clamp(min=1e-6).reciprocal()
        xx, xy, yy = sxx - sx * sx * per + RIDGE, sxy - sx * sy * per, syy - sy * sy * per + RIDGE
        xu, yu = sxu - sx * su * per, syu - sy * su * per
        det = (xx * yy - xy * xy).reciprocal()
        b, c = (yy * xu - xy * yu) * det, (xx * yu - xy * xu) * det
        plane = torch.stack(((su - b * sx - c * sy) * per, b, c))
    fitted = (weight * neighbours(score, LOWEST)).sum(dim=0) * per
    fitted = torch.where((total >= FIT_LEAST) & middle.isfinite(), fitted, LOWEST)
    return plane.view(3, height, width), fitted.view(height, width)


def _planes(
    scope: Scope, lattice: Lattice, distances: Tensor, plane: Tensor, score: Tensor, options: DenseOptions
) -> tuple[Tensor, Planes, Tensor]:
    """What `sweep` returns: each cell goes on from the plane of the lattice pixel it is nearest to."""
    pixels = scope.centers(options.cell).view(-1, 2)
    at = lattice.locate(pixels)
    column, row = at.round().long().unbind(dim=-1)
    column, row = column.clamp(0, lattice.width - 1), row.clamp(0, lattice.height - 1)
    offset = at - torch.stack((column, row), dim=-1)
    score, (a, b, c) = score[row, column].double(), plane[:, row, column].double()
    a = a + b * offset[:, 0] + c * offset[:, 1]
    zero = torch.zeros(len(pixels), dtype=torch.long)
    good = (score > LOWEST) & (a > -0.5) & (a < len(distances) - 0.5) & scope.is_allowed(zero, pixels)
    pixels, a, b, c, score = (t[good] for t in (pixels, a, b, c, score))
    number = torch.arange(len(distances), dtype=torch.float64)
    points = PixelRays.cast(scope.cameras[0], pixels).at(_interpolate(a, number, distances))
    return pixels, Planes(points, _normals(scope, lattice, distances, plane.double())[row[good], column[good]]), score


def _normals(scope: Scope, lattice: Lattice, distances: Tensor, plane: Tensor) -> Tensor:
    """Unit normals (r, c, 3) of the planes (3, r, c) in the world, from where the corners' rays of each pixel end."""
    columns, rows = (torch.arange(n + 1, dtype=torch.float64) - 0.5 for n in (lattice.width, lattice.height))
    rays = PixelRays.cast(scope.cameras[0], lattice.pixels(columns, rows))
    number = torch.arange(len(distances), dtype=torch.float64)

    def end(right: int, below: int) -> Tensor:
        step = plane[0] + (right - 0.5) * plane[1] + (below - 0.5) * plane[2]
        places = slice(below, below + lattice.height), slice(right, right + lattice.width)
        return rays[places].at(_interpolate(step, number, distances))

    normals = torch.linalg.cross(end(1, 1) - end(0, 0), end(0, 1) - end(1, 0), dim=-1)
    return torch.nn.functional.normalize(normals, dim=-1)


def _interpolate(at: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """y(at), linear between x (n), which does not fall, and beyond its ends."""
    i = torch.searchsorted(x, at.contiguous(), right=True).clamp(1, len(x) - 1)
    width = (x[i] - x[i - 1]).clamp(min=1e-12)
    return y[i - 1] + (y[i] - y[i - 1]) * ((at - x[i - 1]) / width)


def _nodes(count: int) -> tuple[Tensor, Tensor]:
    """Places (n) in 0 ... count - 1 that are about `NODE` apart, and the matrix (count, n) that interpolates."""
    n = math.ceil((count - 1) / NODE) + 1
    nodes = torch.linspace(0.0, count - 1.0, n, dtype=torch.float64)
    apart = (torch.arange(count, dtype=torch.float64)[:, None] - nodes).abs() * ((n - 1) / (count - 1))
    return nodes, (1.0 - apart).clamp(min=0.0)


def _ahead(camera: RefractiveCamera, rays: PixelRays, points: Tensor) -> Tensor:
    """Whether points (*B, 3) of the rays lie in front of their camera, not behind it."""
    return ((points - camera.center_in_world) * rays.before).sum(dim=-1) > 0.0


def _copy_of(scope: Scope, image: int, level: int) -> Tensor:
    """The copy (h, w) of a local image."""
    x, y = scope.atlas.offset[image, level].long().tolist()
    width, height = scope.atlas.size[image, level].long().tolist()
    return scope.atlas.sheet[0, 0, y : y + height, x : x + width]


def _allowed(scope: Scope, image: int, level: int, shape: torch.Size) -> Tensor:
    """Which pixels (h, w) of a copy lie where the mask allows it."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in shape), indexing="ij")
    pixels = scope.atlas.origin[image] + 2**level * torch.stack((x, y), dim=-1)
    return scope.is_allowed(torch.full(pixels.shape[:-1], image), pixels)


def _box(values: Tensor, size: int) -> Tensor:
    """Means over size x size pixels of (*B, h, w), where these lie inside: (*B, h - size + 1, w - size + 1)."""
    return _run(_run(values, size, -2), size, -1) * size**-2.0


def _run(values: Tensor, size: int, dim: int) -> Tensor:
    """Sums of `size` neighbours along a dimension, by doubling."""
    out = values.narrow(dim, 0, values.shape[dim] - size + 1)
    if size == 1:
        return out
    half = _run(values, size // 2, dim)
    keep = values.shape[dim] - size + 1
    both = half.narrow(dim, 0, keep) + half.narrow(dim, size // 2, keep)
    return both + values.narrow(dim, size - 1, keep) if size % 2 else both
