"""The refraction equation of one flat interface, solved for batches, with exact implicit derivatives.

A camera `height` h above the water sees a point `depth` d below it at the horizontal `distance` a. The light
ray meets the water at the fraction lambda of that distance, the refrax ratio (Chang & Chen, ICCV 2011,
section 3.2). Through the surface the point appears lifted: it is seen in the direction of a point at
the same horizontal place, but only H = h / lambda below the camera. H is the `apparent height` of the camera
above the point. With s = 1/H, D = a^2 and the index ratio n, Snell's law reads

    F(s) = s (h + d / sqrt(n^2 + (n^2 - 1) D s^2)) - 1 = 0,

with no square root of D: smooth at nadir. For n >= 1 F is increasing and concave, so that Newton climbs
monotonically to the only root from any lower bound; max of the two asymptotes is a tight one, from which
four Halley steps reach rounding error (three in single precision).
"""

from typing import Any, Literal

import torch
from torch import Tensor

from torchrefrac.refraction.quartic import refrax_ratio_companion

Method = Literal["halley", "newton", "companion"]
HALLEY_STEPS = {torch.float64: 4, torch.float32: 3}
NEWTON_STEPS = {torch.float64: 9, torch.float32: 7}
METHODS = ("halley", "newton", "companion")


def solve_refrax(
    height: Tensor | float,
    depth: Tensor | float,
    distance: Tensor | float,
    index_ratio: Tensor | float,
    method: Method = "halley",
) -> Tensor:
    """Refrax ratio lambda in (0, 1]: horizontal (camera to refrax) / (camera to point).

    height > 0: camera above the water; depth >= 0: point below the water; distance >= 0: horizontal, all in
    one unit of length; index_ratio >= 1: n_water / n_air. The arguments broadcast. Differentiable in all
    four, at nadir (distance 0) and index ratio 1 too; the derivatives are those of the implicit function
    theorem whatever the method. "halley" is the fast one, "newton" the simple one, "companion" finds the
    eigenvalues of the paper's quartic (Eq. 4, its constant term with the right sign) and is the oracle.
    Raises ValueError for arguments outside these ranges or shapes that do not broadcast.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}, but must be one of {', '.join(METHODS)}")
    height, depth, distance, index_ratio = _broadcast(height, depth, distance, index_ratio)
    _require(height, "height", height > 0, "above 0")
    _require(depth, "depth", depth >= 0, "at least 0")
    _require(distance, "distance", distance >= 0, "at least 0")
    _require(index_ratio, "index_ratio", index_ratio >= 1, "at least 1")
    return height / apparent_height(height, depth, distance.square(), index_ratio, method)


def apparent_height(
    height: Tensor, depth: Tensor, distance_sq: Tensor, index_ratio: Tensor, method: Method = "halley"
) -> Tensor:
    """H, how far below the camera the point appears to be; takes the square of the horizontal distance.

    All arguments have one shape and dtype and are not checked (see `solve_refrax` for their ranges).
    Differentiable twice, and under `torch.func.vmap`.
    """
    result = _ApparentHeight.apply(height, depth, distance_sq, index_ratio, method)
    assert isinstance(result, Tensor)
    return result


def apparent_height_partials(
    apparent: Tensor, height: Tensor, depth: Tensor, distance_sq: Tensor, index_ratio: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Derivatives of H = `apparent` in height, depth, distance_sq and index_ratio (implicit function theorem).

    With w = (n^2 + (n^2 - 1) D / H^2)^(-1/2) the equation is H = h + d w; all four share the denominator
    1 - d w^3 (n^2 - 1) D / H^3 = (h + d n^2 w^3) / H.
    """
    s = apparent.reciprocal()
    n_sq = index_ratio * index_ratio
    s_sq = s * s
    w_sq = (n_sq + (index_ratio - 1.0) * (index_ratio + 1.0) * distance_sq * s_sq).reciprocal()
    w = w_sq.sqrt()
    dw3 = depth * w * w_sq
    by_height = apparent / (height + dw3 * n_sq)
    by_depth = by_height * w
    by_distance_sq = -0.5 * by_height * dw3 * (index_ratio - 1.0) * (index_ratio + 1.0) * s_sq
    by_index = -by_height * dw3 * index_ratio * (1.0 + distance_sq * s_sq)
    return by_height, by_depth, by_distance_sq, by_index


class _ApparentHeight(torch.autograd.Function):
    """Solve without a graph, differentiate implicitly; `backward` is itself differentiable."""

    generate_vmap_rule = True

    @staticmethod
    def forward(height: Tensor, depth: Tensor, distance_sq: Tensor, index_ratio: Tensor, method: Method) -> Tensor:
        if method == "companion":
            return height / refrax_ratio_companion(height, depth, distance_sq, index_ratio)
        solve = _halley if method == "halley" else _newton
        return solve(height, depth, distance_sq, index_ratio).reciprocal()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(output, *inputs[:4])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        partials = apparent_height_partials(*ctx.saved_tensors)
        return (*(grads[0] * partial for partial in partials), None)


def _start(height: Tensor, depth: Tensor, k_distance_sq: Tensor, index_ratio: Tensor) -> Tensor:
    """The larger of two lower bounds of s: exact at nadir, and exact for a grazing ray."""
    tiny = torch.finfo(height.dtype).tiny
    nadir = (height + depth / index_ratio).reciprocal()
    grazing = (1.0 - depth * k_distance_sq.clamp(min=tiny).rsqrt()) / height
    return torch.maximum(nadir, grazing)


def _halley(height: Tensor, depth: Tensor, distance_sq: Tensor, index_ratio: Tensor) -> Tensor:
    n_sq = index_ratio * index_ratio
    kd = (index_ratio - 1.0) * (index_ratio + 1.0) * distance_sq
    depth_n_sq = depth * n_sq
    s = _start(height, depth, kd, index_ratio)
    for _ in range(HALLEY_STEPS.get(height.dtype, 4)):
        kds = kd * s
        w = (n_sq + kds * s).rsqrt()
        w_sq = w * w
        slope_part = depth_n_sq * w * w_sq
        slope = height + slope_part
        step = (s * (height + depth * w) - 1.0) / slope
        curvature = 1.5 * slope_part * w_sq * kds / slope
        s = s - step / (1.0 + curvature * step)
    return s


def _newton(height: Tensor, depth: Tensor, distance_sq: Tensor, index_ratio: Tensor) -> Tensor:
    n_sq = index_ratio * index_ratio
    kd = (index_ratio - 1.0) * (index_ratio + 1.0) * distance_sq
    s = _start(height, depth, kd, index_ratio)
    for _ in range(NEWTON_STEPS.get(height.dtype, 9)):
        w = (n_sq + kd * s * s).rsqrt()
        s = s - (s * (height + depth * w) - 1.0) / (height + depth * n_sq * w * w * w)
    return s


def _broadcast(*values: Tensor | float) -> list[Tensor]:
    names = ("height", "depth", "distance", "index_ratio")
    given = [value for value in values if isinstance(value, Tensor)]
    for name, value in zip(names, values, strict=True):
        if isinstance(value, Tensor) and not value.is_floating_point():
            raise ValueError(f"{name} has dtype {value.dtype}, but must be a floating-point tensor")
    dtype = given[0].dtype if given else torch.float64
    for tensor in given[1:]:
        dtype = torch.promote_types(dtype, tensor.dtype)
    device = given[0].device if given else None
    tensors = [torch.as_tensor(value, dtype=dtype, device=device) for value in values]
    try:
        return list(torch.broadcast_tensors(*tensors))
    except RuntimeError:
        shapes = ", ".join(f"{name} {tuple(t.shape)}" for name, t in zip(names, tensors, strict=True))
        raise ValueError(f"shapes do not broadcast: {shapes}") from None


def _require(value: Tensor, name: str, holds: Tensor, wants: str) -> None:
    if not bool((holds & value.isfinite()).all()):
        bad = value.detach()[~(holds & value.detach().isfinite())].flatten()[0]
        raise ValueError(f"{name} is {float(bad):g} somewhere, but must be finite and {wants}")
