"""Flat layers between cameras and the water, such as the glass of an aquarium.

With the slope m in the camera's medium and g_i = sqrt((n_i^2 - 1) |m|^2 + n_i^2), a layer of thickness t_i takes a ray
aside by t_i m / g_i, where water of that thickness would by t_i m / g. Behind all layers the ray therefore goes on as
if they were water and its camera stood higher by

    T(m) = sum_i t_i (1 / g_i - 1 / g),

which is below zero for what is denser than water: a known number for every ray, so that all solvers stay as they are.
"""

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import require, require_broadcasting, require_floating
from torchrefrac.numerics import like

Number = Float[Tensor, "*#batch"] | float


@dataclass(frozen=True, eq=False)
class Layers:
    """Flat, parallel layers between the camera's medium and the water, from z = 0 down, the camera's side first.

    index (*#batch, k): refractive index of each relative to the camera's medium, at least 1. thickness (*#batch, k): of
    each, at least 0, in the unit of points and heights.
    """

    index: Float[Tensor, "*#batch k"]
    thickness: Float[Tensor, "*#batch k"]

    def depth(self, reference: Float[Tensor, "..."]) -> Float[Tensor, "*#batch"]:
        """Of the water below z = 0, in the dtype and on the device of `reference`."""
        return like(self.thickness, reference).sum(dim=-1)

    def lift(self, slope: Float[Tensor, "*batch n 2"], g: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
        """T of rays with the slopes m, which water divides by g: what the layers add to the height of the camera."""
        index, thickness = (like(part, g)[..., None, :] for part in (self.index, self.thickness))
        inverse = divisor(slope.square().sum(dim=-1)[..., None], index).reciprocal()
        return (thickness * (inverse - g.reciprocal()[..., None])).sum(dim=-1)


def over_height(layers: Layers | None, height: Number) -> Layers | None:
    """The same in units of a height (*#batch)."""
    if layers is None:
        return None
    return replace(layers, thickness=layers.thickness / like(height, layers.thickness)[..., None])


def divisor(slope_sq: Float[Tensor, "*#batch"], index: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
    """g, by which a medium divides the slope of a ray: g^2 = n^2 + (n^2 - 1) |m|^2."""
    n_sq = index * index
    return (n_sq + (n_sq - 1.0) * slope_sq).sqrt()


def require_layers(layers: Layers, batch: tuple[int, ...]) -> None:
    """Refuse indices below 1, thickness below 0, unequal numbers of both, and what is not one for each problem."""
    for name, value, low in (("index", layers.index, 1.0), ("thickness", layers.thickness, 0.0)):
        require_floating(value, f"layers.{name}")
        if not value.dim():
            raise ValueError(f"layers.{name} has shape (), but must be (*B, k), one number a layer")
        require(value, f"layers.{name}", at_least=low)
    given, wanted = layers.thickness.shape[-1], layers.index.shape[-1]
    if given != wanted:
        raise ValueError(f"layers.thickness has length {given}, but must have {wanted}, that of layers.index")
    shapes = {"layers.index": layers.index.shape[:-1], "layers.thickness": layers.thickness.shape[:-1], "rays": batch}
    require_broadcasting(**shapes)
