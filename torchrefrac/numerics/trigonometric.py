"""Real roots of batches of trigonometric polynomials f(x) = a_0 + sum_k a_k cos kx + b_k sin kx on the circle.

A companion matrix has them among its complex roots, those on the unit circle; scanning is ten times faster and keeps
to real numbers. Between two nodes of a grid f has one root where its sign changes. Where it does not, but its slope
does, the extremum in between is one more node: it tells two roots from none.
"""

import math

import torch
from torch import Tensor

NODES_PER_DEGREE = 32
POLISHES = 4


def fourier_coefficients(samples: Tensor) -> Tensor:
    """(a_0, a_1, b_1, ..., a_d, b_d) (*B, 2d + 1) of the polynomial with the values `samples` at 2 pi i / (2d + 1)."""
    count = samples.shape[-1]
    inverse = _basis(_grid(count, samples), (count - 1) // 2) * (2.0 / count)
    inverse[:, 0] *= 0.5
    return samples @ inverse


def roots_on_circle(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Up to 2d real roots (*B, 2d) in [0, 2 pi] of coefficients (*B, 2d + 1), and which entries are roots (*B, 2d).

    Whether a double root is found is up to rounding; of three roots within 360 / (16 d) degrees one may be.
    """
    degree = (coefficients.shape[-1] - 1) // 2
    start = _grid(NODES_PER_DEGREE * degree, coefficients)
    width = 2.0 * math.pi / len(start)
    derivative = _slope(coefficients)
    basis = _basis(start, degree).T
    below, falling = coefficients @ basis < 0.0, derivative @ basis < 0.0
    _, cell = _changes(falling, 2 * degree)
    extremum = _polish(derivative, start[cell], start[cell] + width, falling.gather(-1, cell))
    middle = start.expand_as(below).scatter(-1, cell, extremum)
    middle_below = below.scatter(-1, cell, (_basis(extremum, degree) @ coefficients[..., None])[..., 0] < 0.0)
    node = torch.stack((start.expand_as(middle), middle), dim=-1).flatten(-2)
    below = torch.stack((below, middle_below), dim=-1).flatten(-2)
    found, at = _changes(below, 2 * degree)
    end = torch.where(at + 1 < node.shape[-1], node.gather(-1, (at + 1) % node.shape[-1]), 2.0 * math.pi)
    return _polish(coefficients, node.gather(-1, at), end, below.gather(-1, at)), found


def _changes(sign: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Up to `count` places (*B, count) where the next sign of (*B, N) is another, and which of them are such."""
    found, at = (sign != sign.roll(-1, dims=-1)).to(torch.uint8).topk(count, dim=-1)
    return found > 0, at


def _polish(coefficients: Tensor, left: Tensor, right: Tensor, below: Tensor) -> Tensor:
    """Steps to the root of the parabola that touches f, cubically convergent and at home beside an extremum.

    It starts in the middle of the bracket; a step that leaves the shrinking bracket halves it instead. below: whether
    f is negative at the left end.
    """
    degree = (coefficients.shape[-1] - 1) // 2
    derivative = _slope(coefficients)
    jet = torch.stack((coefficients, derivative, _slope(derivative)), dim=-1)
    x = 0.5 * (left + right)
    for _ in range(POLISHES):
        value, slope, bend = (_basis(x, degree) @ jet).unbind(dim=-1)
        before = (value < 0.0) == below
        left, right = torch.where(before, x, left), torch.where(before, right, x)
        root = torch.addcmul(slope * slope, value, bend, value=-2.0).sqrt()
        step = x - 2.0 * value / (slope + torch.where(below, root, -root))
        x = torch.where((step >= left) & (step <= right), step, 0.5 * (left + right))
    return x


def _grid(count: int, like: Tensor) -> Tensor:
    return torch.arange(count, dtype=like.dtype, device=like.device) * (2.0 * math.pi / count)


def _basis(x: Tensor, degree: int) -> Tensor:
    """(1, cos x, sin x, ..., cos dx, sin dx) of x (*B): (*B, 2d + 1)."""
    angle = x[..., None] * torch.arange(1, degree + 1, dtype=x.dtype, device=x.device)
    waves = torch.stack((angle.cos(), angle.sin()), dim=-1).flatten(-2)
    return torch.cat((torch.ones_like(x)[..., None], waves), dim=-1)


def _slope(coefficients: Tensor) -> Tensor:
    """Coefficients of f'."""
    waves = coefficients[..., 1:].unflatten(-1, (-1, 2))
    k = torch.arange(1, waves.shape[-2] + 1, dtype=waves.dtype, device=waves.device)
    turned = torch.stack((k * waves[..., 1], -k * waves[..., 0]), dim=-1).flatten(-2)
    return torch.cat((torch.zeros_like(turned[..., :1]), turned), dim=-1)
