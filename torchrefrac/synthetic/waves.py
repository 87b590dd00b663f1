"""Small waves on the water: where rays meet them, how they bend there, and how much light is mirrored."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.synthetic.options import WaveOptions, seeded

SHORTEST = 0.125  # of the longest
STEPS = 20
CLOSE = 1e-12  # to the surface, times the length of the ray
FLATTEST = 0.1  # a step is not longer than if the surface came that much slower towards the ray than calm water does


class Entry(NamedTuple):
    """Where rays enter the water: length along the unit direction, unit direction in the water, cosine of
    incidence, and whether they meet the water at all; where they do not, the rest is meaningless, but finite."""

    length: Float[Tensor, " n"]
    direction: Float[Tensor, "n 3"]
    cosine: Float[Tensor, " n"]
    valid: Bool[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class Waves:
    """z = sum of amplitude sin(number . (x, y) + phase). moments: what decides the phases of each moment; None where
    the waves stand still."""

    number: Float[Tensor, "k 2"]
    amplitude: Float[Tensor, " k"]
    phase: Float[Tensor, " k"]
    moments: int | None = None

    @classmethod
    def draw(cls, options: WaveOptions, seed: int) -> "Waves | None":
        """Sines of random directions and phases, all equally steep; None for calm water.

        Lengths are spread evenly in their logarithm from an eighth of the longest to the longest. The root mean square
        of the slope, that is of the gradient's length, over all the water is `rms_slope`.
        """
        if options.rms_slope == 0.0:
            return None
        generator, k = seeded(seed, "waves"), options.components
        turn, place, phase = torch.rand(3, k, generator=generator, dtype=torch.float64)
        length = options.longest * SHORTEST ** ((torch.arange(k, dtype=torch.float64) + place) / k)
        wave = 2.0 * math.pi / length
        number = wave[:, None] * torch.stack(((2.0 * math.pi * turn).cos(), (2.0 * math.pi * turn).sin()), dim=-1)
        amplitude = options.rms_slope * math.sqrt(2.0 / k) / wave
        return cls(number, amplitude, 2.0 * math.pi * phase, seed if options.moving else None)

    def at(self, moment: int) -> "Waves":
        """The waves at a moment, the same ones for all moments where they stand still. Moments have nothing to do with
        each other, as when photographs are taken seconds apart."""
        if self.moments is None:
            return self
        generator = seeded(self.moments, "moments", moment)
        phase = torch.rand(len(self.phase), generator=generator, dtype=torch.float64)
        return replace(self, phase=2.0 * math.pi * phase)

    @property
    def crest(self) -> float:
        """No point of the surface is higher, nor deeper below z = 0."""
        return float(self.amplitude.abs().sum())

    def surface(self, xy: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 2"]]:
        """Height and gradient at xy."""
        angle = xy @ self.number.mT + self.phase
        return angle.sin() @ self.amplitude, (angle.cos() * self.amplitude) @ self.number

    def enter(self, center: Float[Tensor, " 3"], direction: Float[Tensor, "n 3"], index_ratio: float) -> Entry:
        """Rays from center along unit directions: Newton's method from where they would meet calm water.

        A ray that goes upwards, one that Newton's method does not bring onto the surface (it is nearly level), and one
        that comes to the back of a wave do not meet the water.
        """
        sinks = direction[:, 2] < 0.0
        fall = torch.where(sinks, direction[:, 2], -1.0)
        length = center[2] / -fall
        height, slope = self.surface(center[:2] + length[:, None] * direction[:, :2])
        for _ in range(STEPS):
            gap = center[2] + length * direction[:, 2] - height
            if bool((gap.abs() <= CLOSE * length).logical_or(~sinks).all()):
                break
            speed = direction[:, 2] - (slope * direction[:, :2]).sum(dim=-1)
            length = length - gap / torch.minimum(speed, FLATTEST * fall)
            height, slope = self.surface(center[:2] + length[:, None] * direction[:, :2])
        gap = center[2] + length * direction[:, 2] - height
        normal = torch.cat((-slope, torch.ones_like(slope[:, :1])), dim=-1)
        normal = normal / normal.norm(dim=-1, keepdim=True)
        cosine = -(normal * direction).sum(dim=-1)
        valid = sinks & (length > 0.0) & (gap.abs() <= 1e3 * CLOSE * length) & (cosine > 0.0)
        bent = bend(direction, normal, torch.where(valid, cosine, 1.0), index_ratio)
        return Entry(torch.where(valid, length, 1.0), bent, cosine, valid)


def bend(
    direction: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], cosine: Float[Tensor, " n"], index_ratio: float
) -> Float[Tensor, "n 3"]:
    """Snell's law in vector form: unit directions in the water of unit ones in air that come to a surface of unit
    normals, towards the air, with `cosine` of incidence."""
    onward = (1.0 - (1.0 - cosine.square()) / index_ratio**2).sqrt()
    return direction / index_ratio + (cosine / index_ratio - onward)[:, None] * normal


def reflectance(cosine: Float[Tensor, "*batch"], index_ratio: float) -> Float[Tensor, "*batch"]:
    """Share of unpolarised light that is mirrored where it comes from air with `cosine` of incidence.

    Fresnel's equations (Born & Wolf, Principles of Optics, section 1.5.2): the mean of both polarisations.
    """
    cosine = cosine.clamp(0.0, 1.0)
    in_water = (1.0 - (1.0 - cosine.square()) / index_ratio**2).sqrt()
    across = (cosine - index_ratio * in_water) / (cosine + index_ratio * in_water)
    along = (index_ratio * cosine - in_water) / (index_ratio * cosine + in_water)
    return 0.5 * (across.square() + along.square())
