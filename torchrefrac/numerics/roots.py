"""Roots of batches of small polynomials, and real ones of trigonometric polynomials on the circle,
f(x) = a_0 + sum_k a_k cos kx + b_k sin kx.

A companion matrix has the latter among its complex roots; scanning is ten times faster and keeps to real numbers.
Between two nodes of a grid f has one root where its sign changes. Where it does not, but its slope does, the extremum
in between is one more node: it tells two roots from none.
"""

import math
from itertools import chain

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NODES_PER_DEGREE = 32
POLISHES = 3


def fourier_coefficients(samples: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """(a_0, a_1, b_1, ..., a_d, b_d) of the polynomial with the n = 2d + 1 values `samples` at 2 pi i / n."""
    count = samples.shape[-1]
    inverse = _basis(_grid(count, samples), (count - 1) // 2) * (2.0 / count)
    inverse[:, 0] *= 0.5
    return samples @ inverse


def roots_on_circle(
    coefficients: Float[Tensor, "*batch n"],
) -> tuple[Float[Tensor, "*batch n-1"], Bool[Tensor, "*batch n-1"]]:
    """Up to 2d real roots in [0, 2 pi] of the polynomials with n = 2d + 1 coefficients, and which entries are roots.

    Whether a double root is found is up to rounding; of three roots within 360 / (16 d) degrees one may be.
    """
    degree = (coefficients.shape[-1] - 1) // 2
    start = _grid(NODES_PER_DEGREE * degree, coefficients)
    derivative = _slope(coefficients)
    basis = _basis(start, degree).T
    value, slope = coefficients @ basis, derivative @ basis
    _, cell = _changes(slope, 2 * degree)
    width = 2.0 * math.pi / len(start)
    extremum = _polish(derivative, start[cell], start[cell] + width, *_ends(slope, cell))
    middle = start.expand_as(value).scatter(-1, cell, extremum)
    middle_value = value.scatter(-1, cell, (_basis(extremum, degree) @ coefficients[..., None])[..., 0])
    node = torch.stack((start.expand_as(middle), middle), dim=-1).flatten(-2)
    value = torch.stack((value, middle_value), dim=-1).flatten(-2)
    found, at = _changes(value, 2 * degree)
    left, right = _ends(node, at)
    return _polish(coefficients, left, torch.where(right < left, 2.0 * math.pi, right), *_ends(value, at)), found


def _changes(
    value: Float[Tensor, "*batch n"], count: int
) -> tuple[Bool[Tensor, "*batch {count}"], Int[Tensor, "*batch {count}"]]:
    """Which of up to `count` places are those where the next of the values has another sign, and the places."""
    below = value < 0.0
    found, at = (below != below.roll(-1, dims=-1)).to(torch.uint8).topk(count, dim=-1)
    return found > 0, at


def _ends(
    value: Float[Tensor, "*batch n"], at: Int[Tensor, "*batch k"]
) -> tuple[Float[Tensor, "*batch k"], Float[Tensor, "*batch k"]]:
    """Values at the places `at` and at those that follow, the first after the last."""
    return value.gather(-1, at), value.gather(-1, (at + 1) % value.shape[-1])


def _polish(
    coefficients: Float[Tensor, "*batch n"],
    left: Float[Tensor, "*#batch k"],
    right: Float[Tensor, "*#batch k"],
    at_left: Float[Tensor, "*batch k"],
    at_right: Float[Tensor, "*batch k"],
) -> Float[Tensor, "*batch k"]:
    """Steps to the root of the parabola that touches f, cubically convergent beside an extremum too.

    They start from the end of the bracket where f, given there, is smaller: beside an extremum that is where the root
    is. A step that leaves the shrinking bracket halves it instead.
    """
    degree = (coefficients.shape[-1] - 1) // 2
    derivative = _slope(coefficients)
    jet = torch.stack((coefficients, derivative, _slope(derivative)), dim=-1)
    below = at_left < 0.0
    x = torch.where(at_left.abs() < at_right.abs(), left, right)
    for _ in range(POLISHES):
        value, slope, bend = (_basis(x, degree) @ jet).unbind(dim=-1)
        before = (value < 0.0) == below
        left, right = torch.where(before, x, left), torch.where(before, right, x)
        root = torch.addcmul(slope * slope, value, bend, value=-2.0).sqrt()
        step = x - 2.0 * value / (slope + torch.where(below, root, -root))
        x = torch.where((step >= left) & (step <= right), step, 0.5 * (left + right))
    return x


def _grid(count: int, like: Float[Tensor, "..."]) -> Float[Tensor, " {count}"]:
    return torch.arange(count, dtype=like.dtype, device=like.device) * (2.0 * math.pi / count)


def _basis(x: Float[Tensor, "*batch"], degree: int) -> Float[Tensor, "*batch 2*{degree}+1"]:
    """(1, cos x, sin x, ..., cos dx, sin dx), d = `degree`, each from the one before."""
    c, s = x.cos(), x.sin()
    waves = [(c, s)]
    for _ in range(1, degree):
        before = waves[-1]
        cosine = torch.addcmul(before[0] * c, before[1], s, value=-1.0)
        waves.append((cosine, torch.addcmul(before[1] * c, before[0], s)))
    return torch.stack((torch.ones_like(x), *chain.from_iterable(waves)), dim=-1)


def _slope(coefficients: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """Coefficients of f'."""
    waves = coefficients[..., 1:].unflatten(-1, (-1, 2))
    k = torch.arange(1, waves.shape[-2] + 1, dtype=waves.dtype, device=waves.device)
    turned = torch.stack((k * waves[..., 1], -k * waves[..., 0]), dim=-1).flatten(-2)
    return torch.cat((torch.zeros_like(turned[..., :1]), turned), dim=-1)


def real_roots(
    coefficients: Float[Tensor, "*batch terms"], tolerance: float | None = None
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch n"]]:
    """All roots of `coefficients[0] x^n + ... + coefficients[n]`, and which of them are real.

    coefficients: the n + 1 of each polynomial, highest power first, the first one not zero.
    Returns the real parts and a mask; a root counts as real when its imaginary part is
    below `tolerance` times max(1, |root|) (default: 64 square roots of the machine epsilon, which still
    admits the double roots that rounding has split into a conjugate pair).
    """
    monic = coefficients[..., 1:] / coefficients[..., :1]
    degree = monic.shape[-1]
    companion = torch.diag_embed(monic.new_ones(*monic.shape[:-1], degree - 1), offset=-1)
    companion[..., 0, :] = -monic
    roots = torch.linalg.eigvals(companion)
    if tolerance is None:
        tolerance = 64.0 * torch.finfo(monic.dtype).eps ** 0.5
    is_real = roots.imag.abs() <= tolerance * roots.abs().clamp(min=1.0)
    return roots.real, is_real
