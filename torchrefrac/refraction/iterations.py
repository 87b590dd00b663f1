"""Root finding for the refraction equation of flat layers: values only, no derivatives.

With D the squared horizontal distance, thickness d_i and index n_i >= 1 of layer i relative to the rarest medium, and
`clear` what lies in that medium itself, the unknown s = tan(angle in the rarest medium) / distance solves

    F(s) = s (clear + sum_i d_i w_i) - 1 = 0,      w_i = (n_i^2 + (n_i^2 - 1) D s^2)^(-1/2).

F is increasing and concave: from a lower bound of the root Newton climbs to it and cannot miss. Each term s w_i lies
below its tangent at tan(angle) = m n_i / sqrt(n_i^2 - 1), whatever m, which gives the lower bounds

    s >= (1 - alpha sum_i d_i / sqrt((n_i^2 - 1) D)) / (clear + beta sum_i d_i / n_i),

beta = (1 + m^2)^(-3/2), alpha = m^3 beta. Their envelope over m is the root itself for one layer: m = 0 is exact at
nadir, m = infinity for a grazing ray, and three more in between leave three Halley steps to do.
"""

from collections.abc import Sequence
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry.triples import Part

TANGENTS = tuple((m**3 * (1.0 + m * m) ** -1.5, (1.0 + m * m) ** -1.5) for m in (1.2, 4.0, 16.0))

# Enough for depth/height within 10^+-4: see the accuracy tests. The last step of float32 is one more, in float64.
HALLEY_STEPS = {torch.float64: 3, torch.float32: 2}
NEWTON_STEPS = {torch.float64: 7, torch.float32: 4}
CLIMBS = 3


class Equation:
    """F and what all its evaluations share."""

    def __init__(self, distance_sq: Part, clear: Part, thickness: Sequence[Part], index: Sequence[Part]) -> None:
        self.distance_sq, self.clear, self.thickness, self.index = distance_sq, clear, thickness, index
        self.index_sq = [n * n for n in index]
        self.depth_index_sq = [d * n_sq for d, n_sq in zip(thickness, self.index_sq, strict=True)]
        self.excess = [(n - 1.0) * (n + 1.0) * distance_sq for n in index]

    def double(self) -> "Equation":
        distance_sq, clear = self.distance_sq.double(), self.clear.double()
        return Equation(distance_sq, clear, [d.double() for d in self.thickness], [n.double() for n in self.index])


def find_root(equation: Equation, method: str) -> Float[Tensor, "*batch"]:
    """The root s: Halley's or Newton's method from `lower_bound`.

    In single precision the last step is Halley's in double: for deep water seen at a grazing angle the rounding
    of w alone costs a factor of fifty.
    """
    step = _halley_step if method == "halley" else _newton_step
    steps = (HALLEY_STEPS if method == "halley" else NEWTON_STEPS).get(equation.distance_sq.dtype, 3)
    s = lower_bound(equation)
    if len(equation.index) > 1:
        s = _climb(s, equation)
    for _ in range(steps):
        s = step(s, equation)
    if s.dtype == torch.float32 and s.device.type != "mps":
        s = _halley_step(s.double(), equation.double()).float()
    return s


def screening_height(distance_sq: Part, height: Part, depth: Part, index_ratio: Part) -> Float[Tensor, "*batch"]:
    """Apparent height over one water surface for comparing many hypotheses: values only, in the dtype given.

    height > 0, depth >= 0. Two Halley steps: up to 85 degrees a relative error below 1e-6 in float32 and 1e-10 in
    float64 for depth/height within 10^+-1, below 2e-6 and 3e-9 within 10^+-2.
    """
    equation = Equation(distance_sq, height, [depth], [index_ratio])
    s = lower_bound(equation)
    for _ in range(2):
        s = _halley_step(s, equation)
    return s.reciprocal()


def lower_bound(equation: Equation) -> Float[Tensor, "*batch"]:
    """The largest of five lower bounds of s."""
    clear = equation.clear
    tiny = torch.finfo(clear.dtype).tiny
    layers = list(zip(equation.thickness, equation.index, equation.excess, strict=True))
    nadir = reduce(torch.add, (d / n for d, n, _ in layers))
    grazing = reduce(torch.add, (d * x.clamp(min=tiny).rsqrt() for d, _, x in layers))
    one = clear.new_ones(())
    best = torch.maximum((clear + nadir).reciprocal(), (one - grazing) / clear.clamp(min=tiny))
    for alpha, beta in TANGENTS:
        bound = torch.add(one, grazing, alpha=-alpha) / torch.add(clear, nadir, alpha=beta)
        best = torch.maximum(best, bound)
    return best


def _climb(s: Float[Tensor, "*batch"], equation: Equation) -> Float[Tensor, "*batch"]:
    """A better lower bound from a lower bound, for stacks.

    Where a thin layer of the rarest medium lies beside a nearly as rare one, F has a second knee that Halley may jump
    over. Newton from any point ends below the root: the better of Newton from s and from where Halley jumps.
    """
    for _ in range(CLIMBS):
        residual, slope, bend = _evaluate(s, equation)
        newton = s - residual / slope
        ahead = s - residual * slope / torch.addcmul(slope * slope, residual, bend)
        ahead = torch.where(ahead > s, ahead, newton)
        s = torch.maximum(newton, _newton_step(ahead, equation))
    return s


def _halley_step(s: Float[Tensor, "*batch"], equation: Equation) -> Float[Tensor, "*batch"]:
    residual, slope, bend = _evaluate(s, equation)
    denominator = torch.addcmul(slope * slope, residual, bend)
    return torch.addcdiv(s, residual.mul_(slope), denominator, value=-1.0)


def _newton_step(s: Float[Tensor, "*batch"], equation: Equation) -> Float[Tensor, "*batch"]:
    residual, slope, _ = _evaluate(s, equation)
    return s - residual / slope


def _evaluate(
    s: Float[Tensor, "*batch"], equation: Equation
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """F, dF/ds and -1/2 d2F/ds2. In place wherever a tensor follows from s, which has the full shape."""
    value, slope, bend = equation.clear, equation.clear, None
    terms = zip(equation.thickness, equation.index_sq, equation.depth_index_sq, equation.excess, strict=True)
    for d, n_sq, d_n_sq, excess in terms:
        excess_s = excess * s
        w = torch.addcmul(n_sq, excess_s, s).rsqrt_()
        w_sq = w * w
        value = torch.addcmul(value, d, w)
        part = w.mul_(w_sq).mul_(d_n_sq)
        slope = slope + part
        change = excess_s.mul_(w_sq).mul_(part)
        bend = change if bend is None else bend + change
    assert bend is not None
    return value.mul_(s).sub_(1.0), slope, bend.mul_(1.5)
