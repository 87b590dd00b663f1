"""Reconstructions as training sets."""

from torchrefrac.learning.pixels import PixelTable
from torchrefrac.learning.rays import Rays, RefractiveRays

__all__ = ["PixelTable", "Rays", "RefractiveRays"]
