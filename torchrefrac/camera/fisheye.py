"""The fisheye model of OpenCV (Kannala and Brandt, PAMI 2006): equidistant, and a polynomial of the angle.

A ray at the angle theta from the optical axis has the radius theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4
theta^8). It is written here, like any distortion, as a function of the ideal image-plane coordinates of a pinhole, so
that theta stays below 90 degrees.
"""

import math
from collections.abc import Sequence

import torch

from torchrefrac.camera.rational import DistortionSlopes
from torchrefrac.geometry.triples import Part

SMALL = 1e-6
"""Squared radius below which series take the place of quotients of small numbers."""
WIDEST = 0.5 * math.pi - 1e-6
"""Radians from the optical axis; a pinhole image holds no more."""
STEPS = 8


def fisheye(x: Part, y: Part, coefficients: Sequence[Part]) -> tuple[Part, Part]:
    """Distorted coordinates; of the coefficients the first four count."""
    r2 = x * x + y * y
    angle = _angle_per_radius(r2)
    stretch = angle * _polynomial(r2 * angle * angle, coefficients)
    return x * stretch, y * stretch


def fisheye_slopes(x: Part, y: Part, coefficients: Sequence[Part]) -> DistortionSlopes:
    """`fisheye` with its derivatives; those in further coefficients are zero."""
    k1, k2, k3, k4, *rest = coefficients
    r2 = x * x + y * y
    angle = _angle_per_radius(r2)
    theta2 = r2 * angle * angle
    stretch = angle * _polynomial(theta2, coefficients)
    along = 1.0 + theta2 * (3.0 * k1 + theta2 * (5.0 * k2 + theta2 * (7.0 * k3 + theta2 * 9.0 * k4)))
    small = r2 < SMALL
    by_r2 = (along / (1.0 + r2) - stretch) / torch.where(small, 1.0, 2.0 * r2)
    slope = 2.0 * torch.where(small, k1 - 1.0 / 3.0 + 2.0 * r2 * (0.2 - k1 + k2), by_r2)
    parts, power = [], angle
    for _ in range(4):
        power = power * theta2
        parts.append(power)
    nothing = [torch.zeros_like(r2) for _ in rest]
    return DistortionSlopes(
        u=x * stretch,
        v=y * stretch,
        du_dx=stretch + x * x * slope,
        mixed=x * y * slope,
        dv_dy=stretch + y * y * slope,
        by_u=(*(x * part for part in parts), *nothing),
        by_v=(*(y * part for part in parts), *nothing),
    )


def without_fisheye(u: Part, v: Part, coefficients: Sequence[Part]) -> tuple[Part, Part]:
    """Ideal coordinates whose distortion is (u, v): Newton in the angle, which no wide angle leads astray."""
    k1, k2, k3, k4, *_ = coefficients
    radius = (u * u + v * v).sqrt()
    theta = radius.clamp(max=WIDEST)
    for _ in range(STEPS):
        theta2 = theta * theta
        along = 1.0 + theta2 * (3.0 * k1 + theta2 * (5.0 * k2 + theta2 * (7.0 * k3 + theta2 * 9.0 * k4)))
        off = theta * _polynomial(theta2, coefficients) - radius
        theta = (theta - off / torch.where(along > SMALL, along, 1.0)).clamp(min=0.0, max=WIDEST)
    stretch = theta.tan() / torch.where(radius > 0.0, radius, 1.0)
    stretch = torch.where(radius > 0.0, stretch, 1.0)
    return u * stretch, v * stretch


def _polynomial(theta2: Part, coefficients: Sequence[Part]) -> Part:
    k1, k2, k3, k4, *_ = coefficients
    return 1.0 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4)))


def _angle_per_radius(r2: Part) -> Part:
    """atan(r) / r."""
    small = r2 < SMALL
    r = torch.where(small, 1.0, r2).sqrt()
    return torch.where(small, 1.0 - r2 / 3.0 + r2 * r2 / 5.0, r.atan() / r)
