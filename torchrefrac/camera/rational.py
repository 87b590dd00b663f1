"""Brown-Conrady distortion as OpenCV has it: five coefficients k1, k2, p1, p2, k3, or eight with k4, k5, k6 of the
rational model, whose denominator is 1 without them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from torchrefrac.geometry.triples import Part

LEAST_DENOMINATOR = 1e-3
"""That of the rational model vanishes somewhere outside the image; beyond this it stays what it is."""


class DistortionSlopes(NamedTuple):
    """Distorted (u, v) and derivatives: in the ideal (x, y), where dv/dx = du/dy = mixed, and in each coefficient."""

    u: Part
    v: Part
    du_dx: Part
    mixed: Part
    dv_dy: Part
    by_u: tuple[Part, ...]
    by_v: tuple[Part, ...]


def rational(x: Part, y: Part, coefficients: Sequence[Part]) -> tuple[Part, Part]:
    """Distorted coordinates."""
    k1, k2, p1, p2, k3, *denominator = coefficients
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if denominator:
        radial = radial * _denominator(r2, denominator).clamp(min=LEAST_DENOMINATOR).reciprocal()
    xy2 = 2.0 * x * y
    return (x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x), y * radial + p2 * xy2 + p1 * (r2 + 2.0 * y * y))


def rational_slopes(x: Part, y: Part, coefficients: Sequence[Part]) -> DistortionSlopes:
    """`rational` with its derivatives."""
    k1, k2, p1, p2, k3, *denominator = coefficients
    r2 = x * x + y * y
    r4 = r2 * r2
    r6 = r4 * r2
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    xy2, x2, y2 = 2.0 * x * y, r2 + 2.0 * x * x, r2 + 2.0 * y * y
    powers, below = (r2, r4, r6), ()
    if denominator:
        k4, k5, k6 = denominator
        bottom = _denominator(r2, denominator)
        regular = bottom > LEAST_DENOMINATOR
        inverse = bottom.clamp(min=LEAST_DENOMINATOR).reciprocal()
        radial = radial * inverse
        steep = torch.where(regular, 2.0 * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)), 0.0)
        slope = (slope - radial * steep) * inverse
        below = tuple(torch.where(regular, -radial * inverse * power, 0.0) for power in powers)
        powers = tuple(inverse * power for power in powers)
    first, second, third = powers
    return DistortionSlopes(
        u=x * radial + p1 * xy2 + p2 * x2,
        v=y * radial + p2 * xy2 + p1 * y2,
        du_dx=radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        mixed=x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
        dv_dy=radial + y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y,
        by_u=(x * first, x * second, xy2, x2, x * third, *(x * part for part in below)),
        by_v=(y * first, y * second, y2, xy2, y * third, *(y * part for part in below)),
    )


def _denominator(r2: Part, coefficients: Sequence[Part]) -> Part:
    k4, k5, k6 = coefficients
    return 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
