"""Refraction at flat layers: the solve and its derivatives, lifted points, bent rays, the index of water."""

from torchrefrac.refraction.interface import FlatInterface
from torchrefrac.refraction.iterations import screening_height
from torchrefrac.refraction.layers import HeightPartials, apparent_height, apparent_height_partials
from torchrefrac.refraction.lift import lift_points
from torchrefrac.refraction.rays import refract_rays
from torchrefrac.refraction.snell import solve_refrax
from torchrefrac.refraction.water import FRESH_WATER, SEA_WATER, water_index

__all__ = [
    "FRESH_WATER", "SEA_WATER", "FlatInterface", "HeightPartials", "apparent_height", "apparent_height_partials",
    "lift_points", "refract_rays", "screening_height", "solve_refrax", "water_index",
]  # fmt: skip
