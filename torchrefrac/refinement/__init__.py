"""Polishing what the minimal solvers found, in pixels; many small problems at once."""

from torchrefrac.refinement.absolute import OneView
from torchrefrac.refinement.data import PoseData
from torchrefrac.refinement.points import PointEstimate, refine_points
from torchrefrac.refinement.relative import TwoViews
from torchrefrac.refinement.tilt import tilt_and_heading, tilted_rotation

__all__ = ["OneView", "PointEstimate", "PoseData", "TwoViews", "refine_points", "tilt_and_heading", "tilted_rotation"]
