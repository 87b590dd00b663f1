"""Structure from motion in verbs: `start, register, triangulate, filter_points, adjust` take a scene and rules, and
return a new scene and how it went. `reconstruct_sparse` and `readjust` are two orders of them (paper, section 3)."""

from torchrefrac.sfm.adjust import adjust, with_noise_found
from torchrefrac.sfm.filter_points import filter_points
from torchrefrac.sfm.focal import better_focal, with_likely_focals
from torchrefrac.sfm.gravity import with_right_gravity
from torchrefrac.sfm.growth import NoInitialPairError
from torchrefrac.sfm.incremental import reconstruct_sparse
from torchrefrac.sfm.join import join
from torchrefrac.sfm.known_cameras import triangulate_tracks
from torchrefrac.sfm.outcome import Adjustment, Filtering, Joining, Outcome, Registration, Start, Triangulation
from torchrefrac.sfm.pinhole import PinholeInitializer
from torchrefrac.sfm.placing import Placed, placed_in_survey, upright
from torchrefrac.sfm.ports import PortInitializer
from torchrefrac.sfm.pose import PairPose, Pose, PoseInitializer, Resection
from torchrefrac.sfm.readjust import readjust
from torchrefrac.sfm.refractive import RefractiveInitializer
from torchrefrac.sfm.register import register, register_each, start
from torchrefrac.sfm.rules import ReadjustOptions, Rules, SfmOptions
from torchrefrac.sfm.stated_levels import check_levels
from torchrefrac.sfm.triangulate import triangulate
from torchrefrac.sfm.uncalibrated import uncalibrated
from torchrefrac.sfm.unmodelled import errors_in_air_and_water, fits_better_in_air
from torchrefrac.sfm.verification import VerifiedPair, errors_are_rough, verify_pairs
from torchrefrac.sfm.vertical import UnknownVerticalError, complete_gravity, level_capture
from torchrefrac.sfm.walls import facing_wall, gravity_in_world, looks_through_wall, with_upright_wall
from torchrefrac.sfm.water_level import with_found_level
from torchrefrac.sfm.water_normal import with_found_normal

__all__ = [
    "Adjustment", "Filtering", "Joining", "NoInitialPairError", "Outcome", "PairPose", "PinholeInitializer",
    "Placed", "PortInitializer", "Pose", "PoseInitializer", "ReadjustOptions", "RefractiveInitializer",
    "Registration", "Resection", "Rules", "SfmOptions", "Start", "Triangulation", "UnknownVerticalError",
    "VerifiedPair", "adjust", "better_focal", "check_levels", "complete_gravity", "errors_are_rough",
    "errors_in_air_and_water", "facing_wall", "filter_points", "fits_better_in_air", "gravity_in_world", "join",
    "level_capture", "looks_through_wall", "placed_in_survey", "readjust", "reconstruct_sparse", "register",
    "register_each", "start", "triangulate", "triangulate_tracks", "uncalibrated", "upright", "verify_pairs",
    "with_found_level", "with_found_normal", "with_likely_focals", "with_noise_found", "with_right_gravity",
    "with_upright_wall",
]  # fmt: skip
