"""Rotations, gravity and alignments, free of any camera."""

from torchrefrac.geometry.alignment import Similarity, align_above_plane, align_similarity
from torchrefrac.geometry.gravity import heading_rotation, level_rotation, split_heading
from torchrefrac.geometry.plane import Plane
from torchrefrac.geometry.rigid import Rigid
from torchrefrac.geometry.rotation import rotate, skew, so3_exp, so3_log

__all__ = [
    "Plane", "Rigid", "Similarity", "align_above_plane", "align_similarity", "heading_rotation", "level_rotation",
    "rotate", "skew", "so3_exp", "so3_log", "split_heading",
]  # fmt: skip
