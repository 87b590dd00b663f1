"""Rotations, gravity and alignments, free of any camera."""

from torchrefrac.geometry.alignment import Similarity, align_above_plane, align_similarity
from torchrefrac.geometry.gravity import heading_rotation, level_rotation, levelling, split_heading
from torchrefrac.geometry.plane import Plane
from torchrefrac.geometry.pose_alignment import Freedom, PoseAlignment, align_poses
from torchrefrac.geometry.rigid import Rigid
from torchrefrac.geometry.robust_alignment import are_on_a_line, robust_level_similarity, robust_similarity
from torchrefrac.geometry.rotation import nearest_rotation, rotate, skew, so3_exp, so3_log

__all__ = [
    "Freedom", "Plane", "PoseAlignment", "Rigid", "Similarity", "align_above_plane", "align_poses", "align_similarity",
    "are_on_a_line", "heading_rotation", "level_rotation", "levelling", "nearest_rotation", "robust_level_similarity",
    "robust_similarity", "rotate", "skew", "so3_exp", "so3_log", "split_heading",
]  # fmt: skip
