"""Where an image has something to be recognised by: Harris corners and blobs, as PMVS matches them.

Furukawa & Ponce, "Accurate, dense, and robust multiview stereopsis", PAMI 2010, section 3.1: both kinds, spread evenly
over the image, as many as there are in every square of it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.checks import require

CORNER, BLOB = 0, 1
BORDER = 4  # pixels along the border in which nothing is looked for: filters see beyond it
MIN_CORNER = 0.35**4  # Harris response: slopes, in grey levels a pixel, to the fourth power
MIN_BLOB = 0.8  # difference of Gaussians, grey levels
FINE, COARSE = (1.0, 9), (1.6, 13)  # standard deviations of the Gaussians and sizes of their windows, pixels
MAX_ELONGATION = 10.0  # ratio of a blob's principal curvatures, above which it is a piece of an edge (Lowe, IJCV 2004)
MAX_SHIFT = 1.0  # pixels from a maximum to the vertex of the parabola through it, along each axis
AROUND = tuple((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1))


@dataclass(frozen=True)
class InterestPoints:
    """Points of one image; kind: 0 corner, 1 blob."""

    pixels: Float[Tensor, "n 2"]
    kind: Int[Tensor, " n"]

    def __len__(self) -> int:
        return len(self.kind)


def detect_interest_points(image: Shaped[Tensor, "h w"], per_cell: int = 4, cell: int = 32) -> InterestPoints:
    """Corners and blobs of a grey image, 0 to 255, to a fraction of a pixel.

    Corners are maxima of Harris's response to the image smoothed by a Gaussian, blobs maxima and minima of the
    difference of two Gaussians, among their 3 x 3 neighbours. Each lies at the vertex of the parabola through its
    neighbours. In each square of cell x cell pixels the strongest `per_cell` of either kind stay. Nothing is found
    within 4 pixels of the border, nor where the response is no stronger than noise with a standard deviation of one
    grey level makes it. Points come corners first, square by square, the strongest of each first.

    Raises ValueError for an image that is not (h, w) or not finite, and counts below 1.
    """
    if image.dim() != 2:
        raise ValueError(f"image has shape {tuple(image.shape)}, but must be (height, width)")
    require(image, "image")
    require(per_cell, "per_cell", at_least=1)
    require(cell, "cell", at_least=1)
    height, width = image.shape
    if min(height, width) <= 2 * BORDER:
        empty = image.new_zeros(0, 2, dtype=torch.float64)
        return InterestPoints(empty, empty.new_zeros(0, dtype=torch.long))
    from kornia import feature, filters  # noqa: PLC0415 - importing it takes seconds

    whole = (image if image.is_floating_point() else image.float())[None, None]
    fine, coarse = (filters.gaussian_blur2d(whole, (size, size), (sigma, sigma)) for sigma, size in (FINE, COARSE))
    corner = feature.harris_response(fine)[0, 0]
    blob = feature.dog_response(torch.stack((fine, coarse), dim=2))[0, 0, 0]
    found = (
        _peaks(corner, MIN_CORNER, float("inf")),
        _peaks(blob, MIN_BLOB, MAX_ELONGATION),
        _peaks(-blob, MIN_BLOB, MAX_ELONGATION),
    )
    pixels, strength = (torch.cat(parts) for parts in zip(*found, strict=True))
    kind = torch.full((len(pixels),), BLOB, device=pixels.device)
    kind[: len(found[0][0])] = CORNER
    column, row = (pixels / cell).long().unbind(dim=-1)
    square = (kind * (height // cell + 1) + row) * (width // cell + 1) + column
    best = strongest(square, strength, per_cell)
    return InterestPoints(pixels[best], kind[best])


def _peaks(
    response: Float[Tensor, "h w"], least: float, elongation: float
) -> tuple[Float[Tensor, "k 2"], Float[Tensor, " k"]]:
    """Pixels of the maxima of a response that reach `least`, and the response there. Of equal neighbours the first
    counts. Maxima without a vertex nearby, or elongated ones, are left out."""
    inner = (slice(BORDER, -BORDER),) * 2
    row, column = ((response == _highest(response)) & (response >= least))[inner].nonzero().unbind(dim=-1)
    row, column = row + BORDER, column + BORDER
    around = torch.stack([response[row + down, column + right] for down, right in AROUND], dim=-1)
    first = (around[:, :4] < around[:, 4:5]).all(dim=-1)
    row, column, around = row[first], column[first], around[first].double()
    shift, sharp = _vertex(around, elongation)
    at = torch.stack((column, row), dim=-1) + 0.5 + shift
    return at[sharp], around[sharp, 4]


def _highest(response: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The maximum of the 3 x 3 values around each, away from the border; several times as fast as pooling."""
    highest = response.clone()
    across = torch.maximum(torch.maximum(response[:, :-2], response[:, 1:-1]), response[:, 2:])
    highest[1:-1, 1:-1] = torch.maximum(torch.maximum(across[:-2], across[1:-1]), across[2:])
    return highest


def _vertex(around: Float[Tensor, "k 9"], elongation: float) -> tuple[Float[Tensor, "k 2"], Bool[Tensor, " k"]]:
    """Shift from the middle of 3 x 3 values to the vertex of their parabola, and where there is one. From central
    differences, as in Brown & Lowe, BMVC 2002."""
    nw, n, ne, w, middle, e, sw, s, se = around.unbind(dim=-1)
    gx, gy = (e - w) / 2.0, (s - n) / 2.0
    xx, yy, xy = e + w - 2.0 * middle, s + n - 2.0 * middle, (se + nw - ne - sw) / 4.0
    trace, det = xx + yy, xx * yy - xy.square()
    peaked = (trace < 0.0) & (det > 0.0)
    safe = torch.where(peaked, det, 1.0)
    shift = torch.stack((xy * gy - yy * gx, xy * gx - xx * gy), dim=-1) / safe[:, None]
    rounded = trace.square() / safe < (elongation + 1.0) ** 2 / elongation if elongation < float("inf") else peaked
    return shift, peaked & rounded & (shift.abs() <= MAX_SHIFT).all(dim=-1)


def strongest(group: Int[Tensor, " n"], strength: Float[Tensor, " n"], count: int) -> Int[Tensor, " k"]:
    """Rows, group by group, of the `count` strongest of each group, the strongest first."""
    order = strength.argsort(descending=True, stable=True)
    order = order[group[order].argsort(stable=True)]
    group = group[order]
    rank = torch.arange(len(group), device=group.device) - torch.searchsorted(group, group)
    return order[rank < count]
