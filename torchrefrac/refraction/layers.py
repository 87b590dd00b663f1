"""How high a camera appears to stand above a point behind flat layers, with exact implicit derivatives.

A ray that leaves the camera crosses layers of thickness d_i and refractive index n_i down to the point. Its horizontal
ways add up to the distance a. Let n_i be relative to the rarest medium, `clear` what lies in that medium itself, and
s = tan(angle in the rarest medium) / a. Snell's law then reads

    F(s) = s (clear + sum_i d_i w_i) - 1 = 0,      w_i = (n_i^2 + (n_i^2 - 1) D s^2)^(-1/2),      D = a^2,

with no square root of D: smooth at nadir. Seen from the rarest medium the point appears at its own horizontal place,
but only G = 1/s below the camera. For one water surface, where the air is the rarest medium and holds the camera,
G = h / lambda with the refrax ratio lambda of Chang & Chen (ICCV 2011). The implicit function theorem gives, with
Q = clear + sum_i d_i n_i^2 w_i^3,

    dG/dclear = G/Q     dG/dd_i = w_i G/Q     dG/dn_i = -d_i n_i w_i^3 (1 + D s^2) G/Q
    dG/dD = -s^2/2 sum_i d_i w_i^3 (n_i^2 - 1) G/Q.

They hold for any reference index up to the smallest one: which layer is the rarest need not be known to differentiate.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry.triples import Part
from torchrefrac.refraction.iterations import Equation, find_root
from torchrefrac.refraction.quartic import refrax_ratio_companion

Method = Literal["halley", "newton", "companion"]
METHODS = ("halley", "newton", "companion")


class HeightPartials(NamedTuple):
    """Derivatives of an apparent height: in D, in `clear`, in the thickness and the index of every layer."""

    by_distance_sq: Part
    by_clear: Part
    by_thickness: tuple[Part, ...]
    by_index: tuple[Part, ...]


def apparent_slope(
    distance_sq: Part, clear: Part, thickness: Sequence[Part], index: Sequence[Part], method: Method = "halley"
) -> Float[Tensor, "*batch"]:
    """s, the tangent of the ray's angle in the rarest medium over the horizontal distance.

    distance_sq: square of the horizontal distance; clear >= 0: way through the rarest medium along the vertical, as far
    as that medium is known; thickness >= 0 of each other layer, and index >= 1 of each relative to the rarest: 1 for
    a layer that turns out to be it. All of one dtype, broadcasting, and not checked. What lies in the rarest
    medium must be positive: beyond its critical angle a denser medium sends no light. Differentiable twice, under
    `torch.func` (vmap, jacrev, jacfwd) and `torch.compile`.
    """
    arguments = (method, distance_sq, clear, *thickness, *index)
    if not torch.compiler.is_compiling():
        return _ForwardDifferentiable.apply(*arguments)
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in arguments[1:]):
        return _Slope.apply(*arguments)
    return _Slope.forward(*arguments)


def apparent_height(
    distance_sq: Part, clear: Part, thickness: Sequence[Part], index: Sequence[Part], method: Method = "halley"
) -> Float[Tensor, "*batch"]:
    """G = 1/s, how far below a camera in the rarest medium the point appears to be; see `apparent_slope`."""
    return apparent_slope(distance_sq, clear, thickness, index, method).reciprocal()


def apparent_height_partials(
    apparent: Part, distance_sq: Part, clear: Part, thickness: Sequence[Part], index: Sequence[Part]
) -> HeightPartials:
    """Derivatives of G = `apparent`, in closed form."""
    return _partials(apparent.reciprocal(), apparent, distance_sq, clear, thickness, index)


def _partials(
    s: Part, scale: Part, distance_sq: Part, clear: Part, thickness: Sequence[Part], index: Sequence[Part]
) -> HeightPartials:
    """Those of G for scale = G, those of s = 1/G for scale = -s."""
    s_sq = s * s
    tangent_sq = distance_sq * s_sq
    secant_sq = 1.0 + tangent_sq
    layers, slope, bend = [], clear, torch.zeros_like(s)
    for d, n in zip(thickness, index, strict=True):
        excess = (n - 1.0) * (n + 1.0)
        w = torch.addcmul(n * n, excess, tangent_sq).rsqrt()
        d_w3 = d * (w * w * w)
        layers.append((w, d_w3 * n))
        slope = slope + d_w3 * (n * n)
        bend = bend + d_w3 * excess
    unit = scale / slope
    return HeightPartials(
        by_distance_sq=-0.5 * unit * bend * s_sq,
        by_clear=unit,
        by_thickness=tuple(unit * w for w, _ in layers),
        by_index=tuple(-unit * d_n_w3 * secant_sq for _, d_n_w3 in layers),
    )


class _Slope(torch.autograd.Function):
    """Solve without a graph, differentiate implicitly; `backward` is itself differentiable."""

    generate_vmap_rule = True

    @staticmethod
    def forward(method: Method, distance_sq: Part, clear: Part, *layers: Part) -> Float[Tensor, "*batch"]:
        thickness, index = _halves(layers)
        if method == "companion":
            return refrax_ratio_companion(clear, thickness[0], distance_sq, index[0]) / clear
        if len(thickness) > 1:
            clear, thickness = _split_off_the_rarest(clear, thickness, index)
        return find_root(Equation(distance_sq, clear, thickness, index), method)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Float[Tensor, "*batch"]) -> None:
        ctx.save_for_backward(output, *inputs[1:])
        ctx.save_for_forward(output, *inputs[1:])

    @staticmethod
    def backward(ctx: Any, *grads: Float[Tensor, "*batch"]) -> tuple[Part | None, ...]:
        return None, *(grads[0] * partial for partial in _saved_partials(ctx))


class _ForwardDifferentiable(_Slope):
    """With a rule for forward mode too, which the compiler refuses."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        pairs = zip(tangents[1:], _saved_partials(ctx), strict=True)
        return sum(tangent * partial for tangent, partial in pairs if tangent is not None)


def _saved_partials(ctx: Any) -> list[Part]:
    s, distance_sq, clear, *layers = ctx.saved_tensors
    partials = _partials(s, -s, distance_sq, clear, *_halves(layers))
    return [partials.by_distance_sq, partials.by_clear, *partials.by_thickness, *partials.by_index]


def _halves(layers: Sequence[Part]) -> tuple[Sequence[Part], Sequence[Part]]:
    half = len(layers) // 2
    return layers[:half], layers[half:]


def _split_off_the_rarest(clear: Part, thickness: Sequence[Part], index: Sequence[Part]) -> tuple[Part, list[Part]]:
    """Thickness of the layers of index 1 moved to `clear`: the start of the iteration needs it there."""
    dense = []
    for d, n in zip(thickness, index, strict=True):
        clear = clear + torch.where(n == 1.0, d, 0.0)
        dense.append(torch.where(n == 1.0, 0.0, d))
    return clear, dense
