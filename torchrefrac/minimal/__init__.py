"""Pose and triangulation solvers: batched pure functions that return candidates and which of them are valid.

They refuse rays and points of the wrong shape or with a NaN. Loops over arrays that have been checked once call the
`unchecked_` function of the same name in the solver's module.

Pose solvers take rays in the gravity-aligned ("level") frame: v = level_from_cam K^-1 u, z up, so v_z < 0 for a ray
that goes down to the water. See `torchrefrac.geometry.level_rotation`. `Layers`, such as glass, may lie before the
water; up is their normal then, towards the cameras.
"""

from torchrefrac.minimal.absolute_pose import absolute_pose_2pt, absolute_pose_lsqi
from torchrefrac.minimal.four_point import relative_pose_4pt
from torchrefrac.minimal.known_heading import absolute_pose_known_heading, relative_pose_3pt
from torchrefrac.minimal.layers import Layers
from torchrefrac.minimal.relative_pose import relative_pose_7pt, relative_pose_npt
from torchrefrac.minimal.triangulation import triangulate, triangulation_angle

__all__ = [
    "Layers", "absolute_pose_2pt", "absolute_pose_known_heading", "absolute_pose_lsqi", "relative_pose_3pt",
    "relative_pose_4pt", "relative_pose_7pt", "relative_pose_npt", "triangulate", "triangulation_angle",
]  # fmt: skip
