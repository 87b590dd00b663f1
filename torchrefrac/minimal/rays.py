"""What level rays say about the water below them, and the checks of rays that users hand in."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchrefrac.checks import require, require_floating
from torchrefrac.minimal.layers import Layers, Number, divisor, require_layers
from torchrefrac.numerics import like

Rays = Float[Tensor, "*batch n 3"]


class Slopes(NamedTuple):
    """Of rays: m in air, w in the water; lift: what layers between both add to the camera's height, None: no layers."""

    m: Float[Tensor, "*batch n 2"]
    w: Float[Tensor, "*batch n 2"]
    lift: Float[Tensor, "*batch n"] | None = None

    @property
    def from_one(self) -> Float[Tensor, "*batch n 2"]:
        """Way from where the rays of a camera at height 1 seem to enter the water back to below the camera."""
        return self.m if self.lift is None else (1.0 + self.lift)[..., None] * self.m


def slopes(
    rays: Float[Tensor, "*batch 3"], index_ratio: Float[Tensor, "*#batch"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Horizontal slope in air m = v_xy / v_z, and the factor g by which water divides it.

    A point at p_z < 0 on the ray of a camera at height h lies at p_xy = -h m + p_z m / g from the camera
    (Chang & Chen, ICCV 2011, Eq. 9), g^2 = n^2 + (n^2 - 1) |m|^2.
    """
    slope = rays[..., :2] / rays[..., 2:]
    return slope, divisor(slope.square().sum(dim=-1), index_ratio)


def bent(rays: Rays, index_ratio: Number, layers: Layers | None = None) -> Slopes:
    """Slopes of rays on both sides of the surface, or of layers."""
    m, g = slopes(rays, like(index_ratio, rays)[..., None])
    return Slopes(m, m / g[..., None], None if layers is None else layers.lift(m, g))


def seen_along(
    rays: Rays, z: Float[Tensor, "*batch n"], index_ratio: Number, layers: Layers | None = None
) -> tuple[Float[Tensor, "*batch n 2"], Float[Tensor, "*batch n"]]:
    """Slopes of rays in air, and the z at which points at `z` are seen along them: z / g - T in the water, z itself in
    air. A point between both, which would be inside the layers, counts as if there were water around it."""
    m, g = slopes(rays, like(index_ratio, rays)[..., None])
    wet = z / g
    if layers is not None:
        wet = wet - layers.lift(m, g)
    return m, torch.where(z < 0.0, wet, z)


def meet_below(
    heading: Float[Tensor, "*batch others"],
    center: Sequence[Float[Tensor, "*batch others"]],
    first: Slopes,
    second: Slopes,
    layers: Layers | None = None,
) -> Bool[Tensor, "*batch others"]:
    """Whether all rays of a camera at (0, 0, 1), heading 0, meet those of others below the surface, or below layers.

    The rays enter the water, or seem to where there are layers, at q_k = c_k - (c_kz + T_k) m_k and pass each
    other at the depth (q_1 - q_2) . (w_1 - w_2) / |w_1 - w_2|^2.
    """
    c, s = heading.cos()[..., None, :], heading.sin()[..., None, :]
    (m1x, m1y), (w1x, w1y) = (part[..., None, :].unbind(dim=-1) for part in (first.from_one, first.w))
    (m2x, m2y), (w2x, w2y) = (part[..., None, :].unbind(dim=-1) for part in (second.m, second.w))
    x, y, z = (part[..., None, :] for part in center)
    if second.lift is not None:
        z = z + second.lift[..., None]
    dx, dy = w1x - c * w2x - s * w2y, w1y - c * w2y + s * w2x
    along = (z * (c * m2x + s * m2y) - x - m1x) * dx + (z * (c * m2y - s * m2x) - y - m1y) * dy
    least = 0.0 if layers is None else layers.depth(along)[..., None, None] * (dx * dx + dy * dy)
    return (along > least).all(dim=-2)


def look_down(rays1: Rays, rays2: Rays) -> Bool[Tensor, "*batch"]:
    """Whether all rays of both cameras go down to the water."""
    return ((rays1[..., 2] < 0.0) & (rays2[..., 2] < 0.0)).all(dim=-1)


def cross2(a: Float[Tensor, "*batch 2"], b: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Two-dimensional cross product."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def require_matches(plane: Float[Tensor, "n 2"], **others: Shaped[Tensor, "n columns"]) -> None:
    """Refuse image coordinates that are not pairs, and what does not belong to as many matches."""
    if plane.dim() != 2 or plane.shape[-1] != 2:
        raise ValueError(f"image coordinates have shape {tuple(plane.shape)}, but must be (N, 2)")
    for name, value in others.items():
        if len(value) != len(plane):
            raise ValueError(f"{name} has {len(value)} rows, but there are {len(plane)} image coordinates")


def require_rays(
    solver: str,
    count: int,
    index_ratio: Number,
    weights: Float[Tensor, "*batch n"] | None = None,
    *,
    or_more: bool = False,
    layers: Layers | None = None,
    **batches: Rays,
) -> None:
    """Refuse anything but two batches (*B, count, 3) of finite rays or points, or of more of them, an index ratio of at
    least 1, weights, one a ray, finite and at least zero, and layers that can be."""
    (name, first), (other, second) = batches.items()
    if first.shape != second.shape or first.dim() < 2 or first.shape[-1] != 3:
        wanted = f"(*B, {'n' if or_more else count}, 3)"
        raise ValueError(f"{name} {tuple(first.shape)} and {other} {tuple(second.shape)} must both be {wanted}")
    given = first.shape[-2]
    if given < count or (given > count and not or_more):
        wanted = f"needs at least {count}" if or_more else f"takes exactly {count}"
        raise ValueError(f"{name} has {given} rays, but {solver} {wanted}")
    for label, batch in batches.items():
        require_floating(batch, label)
        require(batch, label)
    require(index_ratio, "index_ratio", at_least=1.0)
    if layers is not None:
        require_layers(layers, first.shape[:-2])
    if weights is not None:
        if weights.shape != first.shape[:-1]:
            wanted = tuple(first.shape[:-1])
            raise ValueError(f"weights has shape {tuple(weights.shape)}, but must be {wanted}, one a ray")
        require(weights, "weights", at_least=0.0)
