"""Incremental structure from motion, as in section 3 of the paper."""

from torchrefrac.sfm.incremental import NoInitialPairError, reconstruct_sparse
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.pinhole import PinholeInitializer
from torchrefrac.sfm.pose import PairPose, Pose, PoseInitializer
from torchrefrac.sfm.refractive import RefractiveInitializer
from torchrefrac.sfm.verification import VerifiedPair, verify_pairs
from torchrefrac.sfm.vertical import UnknownVerticalError, level_capture

__all__ = [
    "NoInitialPairError",
    "PairPose",
    "PinholeInitializer",
    "Pose",
    "PoseInitializer",
    "RefractiveInitializer",
    "SfmOptions",
    "UnknownVerticalError",
    "VerifiedPair",
    "level_capture",
    "reconstruct_sparse",
    "verify_pairs",
]
