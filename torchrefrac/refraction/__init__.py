"""Refraction at a flat water surface z = 0: the Snell solve, its derivatives, lifted points and bent rays."""

from torchrefrac.refraction.interface import FlatInterface
from torchrefrac.refraction.lift import Lift, lift_points, lift_with_partials
from torchrefrac.refraction.rays import refract_rays
from torchrefrac.refraction.snell import apparent_height, apparent_height_partials, solve_refrax

__all__ = [
    "FlatInterface",
    "Lift",
    "apparent_height",
    "apparent_height_partials",
    "lift_points",
    "lift_with_partials",
    "refract_rays",
    "solve_refrax",
]
