"""How far two pixels are from seeing one point under water: the refractive epipolar constraint, in pixels.

The ray of camera k enters the water at q_k = c_k - c_kz m_k and goes on with the horizontal slope w_k = m_k / g_k per
unit of z (m_k = v_xy / v_z, g_k^2 = n^2 + (n^2 - 1) |m_k|^2; Chang & Chen, ICCV 2011, Eq. 9). Two such lines meet where

    f = (q_1 - q_2) x (w_1 - w_2) = 0,

and they meet below the surface where (q_1 - q_2) . (w_1 - w_2) > 0. There is no epipolar line, but f is smooth in the
four image coordinates, so that e = f / |df/d(u_1, u_2)| (Sampson) is, to first order in the noise, the length of the
smallest correction of both pixels that makes the rays meet: the reprojection error of the best point, which need not be
found.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import triples
from torchrefrac.geometry.triples import Part, Triple

Pair = tuple[Part, Part]


class Views(NamedTuple):
    """Cameras and the rays of pixels: rotation as rows and center as components, with a last dimension of 1; plane: the
    ideal image coordinates x, y, along that dimension, which focal (fx, fy) turns into pixels."""

    rotation: tuple[Triple, Triple, Triple]
    center: Triple
    plane: Pair
    focal: Pair


class EpipolarError(NamedTuple):
    """error, signed, in pixels; depth below the surface at which the rays pass each other horizontally nearest; down:
    whether both rays go down to the water."""

    error: Float[Tensor, "*batch n"]
    depth: Float[Tensor, "*batch n"]
    down: Bool[Tensor, "*batch n"]

    @property
    def possible(self) -> Bool[Tensor, "*batch n"]:
        """Whether the two rays can come from one point under water."""
        return self.down & (self.depth > 0.0)

    @property
    def squared(self) -> Float[Tensor, "*batch n"]:
        """Infinite where the rays do not meet below the water."""
        return torch.where(self.possible, self.error.square(), torch.inf)


class EpipolarJacobian(NamedTuple):
    """error in pixels with its derivatives: in a turn of each camera about the axes of the world, R <- R exp([t]x), and
    in each centre."""

    error: Part
    turn: tuple[Triple, Triple]
    center: tuple[Triple, Triple]


class _Ray(NamedTuple):
    """v in the world, 1 / v_z, the slopes m in air and w in the water, 1 / g, and where the ray enters the water."""

    v: Triple
    inverse_z: Part
    m: Pair
    w: Pair
    inverse_g: Part
    q: Pair


def epipolar_error(first: Views, second: Views, index_ratio: Float[Tensor, ""]) -> EpipolarError:
    """Error of matches in two views."""
    seen = _constrain(first, second, index_ratio)
    return EpipolarError(seen.value * seen.square.rsqrt(), seen.depth, seen.down)


def epipolar_jacobian(first: Views, second: Views, index_ratio: Float[Tensor, ""]) -> EpipolarJacobian:
    """Error of matches in two views and its derivatives in both cameras.

    Everything is linearised at the corrected pixels, where the rays meet (Gauss-Helmert). At the measured ones the
    noise of the error and of its derivatives would be correlated, which biases the least-squares pose by more than its
    standard deviation.
    """
    seen = _constrain(first, second, index_ratio)
    back = seen.value / seen.square
    corrected = [
        view._replace(plane=tuple(x - back * s / f for x, s, f in zip(view.plane, slopes, view.focal, strict=True)))
        for view, slopes in zip((first, second), seen.by_pixel, strict=True)
    ]
    there = _constrain(corrected[0], corrected[1], index_ratio)
    value = there.value
    for view, moved, slopes in zip((first, second), corrected, there.by_pixel, strict=True):
        for x, at, slope, f in zip(view.plane, moved.plane, slopes, view.focal, strict=True):
            value = torch.addcmul(value, slope, (x - at) * f)
    scale = there.square.rsqrt()
    turn = tuple(triples.scaled(scale, triples.cross(b, r.v)) for b, r in zip(there.by_v, there.rays, strict=True))
    px, py = scale * there.by_q[0], scale * there.by_q[1]
    center = tuple((px, py, -(px * ray.m[0] + py * ray.m[1])) for ray in there.rays)
    opposite = (-center[1][0], -center[1][1], -center[1][2])
    return EpipolarJacobian(value * scale, (turn[0], turn[1]), (center[0], opposite))


def rays_in_water(
    view: Views, index_ratio: Float[Tensor, ""]
) -> tuple[Float[Tensor, "*batch n 3"], Float[Tensor, "*batch n 3"]]:
    """Where the rays enter the water, and their unit directions from there, upwards."""
    ray = _ray(view, index_ratio, (index_ratio - 1.0) * (index_ratio + 1.0))
    origins, slopes = torch.stack(ray.q, dim=-1), torch.stack(ray.w, dim=-1)
    directions = torch.nn.functional.normalize(torch.nn.functional.pad(slopes, (0, 1), value=1.0), dim=-1)
    return torch.nn.functional.pad(origins, (0, 1)), directions


class _Constraint(NamedTuple):
    """f, where the rays meet, whether they go down; the derivatives of f in both rays v, in both pixels and in q_1, and
    the sum of squares of those in pixels."""

    value: Part
    depth: Part
    down: Bool[Tensor, "*#batch"]
    rays: tuple[_Ray, _Ray]
    by_v: tuple[Triple, Triple]
    by_pixel: tuple[Pair, Pair]
    by_q: Pair
    square: Part


def _constrain(first: Views, second: Views, index_ratio: Float[Tensor, ""]) -> _Constraint:
    excess = (index_ratio - 1.0) * (index_ratio + 1.0)
    one, two = (_ray(view, index_ratio, excess) for view in (first, second))
    (gx, gy), (wx, wy) = ((a[0] - b[0], a[1] - b[1]) for a, b in ((one.q, two.q), (one.w, two.w)))
    by_q, by_w = (wy, -wx), (-gy, gx)
    b1 = _by_ray(first, one, 1.0, by_q, by_w, excess)
    b2 = _by_ray(second, two, -1.0, by_q, by_w, excess)
    by_pixel = tuple(
        (triples.dot(view.rotation[0], b) / view.focal[0], triples.dot(view.rotation[1], b) / view.focal[1])
        for view, b in ((first, b1), (second, b2))
    )
    apart = torch.addcmul(wx * wx, wy, wy).clamp(min=torch.finfo(wx.dtype).tiny)  # of slopes, squared
    (ux, uy), (vx, vy) = by_pixel
    square = torch.addcmul(torch.addcmul(torch.addcmul(ux * ux, uy, uy), vx, vx), vy, vy)
    return _Constraint(
        value=torch.addcmul(gx * wy, gy, wx, value=-1.0),
        depth=torch.addcmul(gx * wx, gy, wy) / apart,
        down=(one.inverse_z < 0.0) & (two.inverse_z < 0.0),
        rays=(one, two),
        by_v=(b1, b2),
        by_pixel=(by_pixel[0], by_pixel[1]),
        by_q=by_q,
        square=square.clamp(min=torch.finfo(square.dtype).tiny),
    )


def _ray(view: Views, index_ratio: Float[Tensor, ""], excess: Float[Tensor, ""]) -> _Ray:
    x, y = view.plane
    first, second, third = view.rotation
    v = tuple(torch.addcmul(torch.addcmul(c, a, x), b, y) for a, b, c in zip(first, second, third, strict=True))
    inverse_z = v[2].reciprocal()
    mx, my = v[0] * inverse_z, v[1] * inverse_z
    inverse_g = torch.addcmul(index_ratio * index_ratio, excess, torch.addcmul(mx * mx, my, my)).rsqrt()
    cx, cy, cz = view.center
    q = (torch.addcmul(cx, cz, mx, value=-1.0), torch.addcmul(cy, cz, my, value=-1.0))
    return _Ray((v[0], v[1], v[2]), inverse_z, (mx, my), (mx * inverse_g, my * inverse_g), inverse_g, q)


def _by_ray(view: Views, ray: _Ray, sign: float, by_q: Pair, by_w: Pair, excess: Float[Tensor, ""]) -> Triple:
    """Derivative of f in v, through m: q falls by c_z m, and dw/dm = 1/g - (n^2 - 1) m m^T / g^3."""
    (mx, my), (rx, ry) = ray.m, by_w
    bend = excess * ray.inverse_g.square() * torch.addcmul(mx * rx, my, ry)
    cz = view.center[2]
    ax, ay = (
        torch.addcmul(ray.inverse_g * torch.addcmul(r, bend, m, value=-1.0), cz, p, value=-1.0)
        for r, m, p in ((rx, mx, by_q[0]), (ry, my, by_q[1]))
    )
    factor = sign * ray.inverse_z
    return factor * ax, factor * ay, -factor * torch.addcmul(ax * mx, ay, my)
