"""Root finding for the refraction equation of flat layers: values only, no derivatives.

With D the squared horizontal distance, thickness d_i and index n_i >= 1 of layer i relative to the rarest medium, and
`clear` what lies in that medium itself, the unknown s = tan(angle in the rarest medium) / distance solves

    F(s) = s (clear + sum_i d_i w_i) - 1 = 0,      w_i = (n_i^2 + (n_i^2 - 1) D s^2)^(-1/2).

F is increasing and concave: from a lower bound of the root Newton climbs to it and cannot miss.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

# Enough for depth/height within 10^+-3, up to 89.9 degrees, any index ratio within 2.5: see the accuracy tests.
HALLEY_STEPS = {torch.float64: 5, torch.float32: 3}
NEWTON_STEPS = {torch.float64: 10, torch.float32: 7}
STACK_STEPS = 4


def apparent_slope(
    distance_sq: Tensor, clear: Tensor, thickness: Sequence[Tensor], index: Sequence[Tensor], method: str
) -> Tensor:
    """The root s (*B): Halley's or Newton's method from `lower_bound`.

    In single precision the last step is Halley's in double: for deep water seen at a grazing angle the rounding
    of w alone costs a factor of fifty.
    """
    step = _halley_step if method == "halley" else _newton_step
    steps = (HALLEY_STEPS if method == "halley" else NEWTON_STEPS).get(distance_sq.dtype, 5)
    steps += STACK_STEPS * (len(thickness) > 1)
    terms = _Terms(distance_sq, clear, thickness, index)
    s = lower_bound(distance_sq, clear, thickness, index)
    for _ in range(steps):
        s = step(s, terms)
    if s.dtype == torch.float32 and s.device.type != "mps":
        in_double = _Terms(
            distance_sq.double(), clear.double(), [d.double() for d in thickness], [n.double() for n in index]
        )
        s = _halley_step(s.double(), in_double).float()
    return s


def lower_bound(distance_sq: Tensor, clear: Tensor, thickness: Sequence[Tensor], index: Sequence[Tensor]) -> Tensor:
    """The larger of two lower bounds of s: one exact at nadir, one exact for a grazing ray."""
    tiny = torch.finfo(distance_sq.dtype).tiny
    nadir, hidden = clear, torch.zeros_like(clear)
    for d, n in zip(thickness, index, strict=True):
        nadir = nadir + d / n
        hidden = hidden + d * ((n - 1.0) * (n + 1.0) * distance_sq).clamp(min=tiny).rsqrt()
    grazing = (1.0 - hidden) / clear.clamp(min=tiny)
    return torch.maximum(nadir.reciprocal(), grazing)


class _Terms:
    """What every step needs of the equation, computed once."""

    def __init__(
        self, distance_sq: Tensor, clear: Tensor, thickness: Sequence[Tensor], index: Sequence[Tensor]
    ) -> None:
        self.clear = clear
        self.layers = []
        for d, n in zip(thickness, index, strict=True):
            n_sq = n * n
            self.layers.append((d, n_sq, d * n_sq, (n - 1.0) * (n + 1.0) * distance_sq))


def _halley_step(s: Tensor, terms: _Terms) -> Tensor:
    value, slope, half_bend = terms.clear, terms.clear, 0.0
    for d, n_sq, d_n_sq, excess in terms.layers:
        excess_s = excess * s
        w_sq = (n_sq + excess_s * s).reciprocal()
        w = w_sq.sqrt()
        part = d_n_sq * (w * w_sq)
        value = value + d * w
        slope = slope + part
        half_bend = half_bend + 1.5 * part * w_sq * excess_s
    residual = s * value - 1.0
    return s - residual * slope / (slope * slope + residual * half_bend)


def _newton_step(s: Tensor, terms: _Terms) -> Tensor:
    value, slope = terms.clear, terms.clear
    for d, n_sq, d_n_sq, excess in terms.layers:
        w = (n_sq + excess * s * s).rsqrt()
        value = value + d * w
        slope = slope + d_n_sq * (w * w * w)
    return s - (s * value - 1.0) / slope
