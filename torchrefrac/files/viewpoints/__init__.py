"""Positions of cameras as other programs write them."""

from torchrefrac.files.viewpoints.read import read_viewpoints, viewpoints_of
from torchrefrac.files.viewpoints.write import write_angles, write_orientations

__all__ = ["read_viewpoints", "viewpoints_of", "write_angles", "write_orientations"]
