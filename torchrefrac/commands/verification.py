"""Which matches agree on a pose, by the model that was asked for and with gravity that can be used."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from torchrefrac.bundle.rows import INTRINSICS
from torchrefrac.checks import TorchrefracError
from torchrefrac.config import Options
from torchrefrac.features import Features, PairMatches
from torchrefrac.files.work import Work
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture
from torchrefrac.sfm import (
    PinholeInitializer,
    PortInitializer,
    PoseInitializer,
    RefractiveInitializer,
    SfmOptions,
    VerifiedPair,
    errors_are_rough,
    verify_pairs,
    with_right_gravity,
)

ROUGH = "clearly more matches agree within sfm.rough_error, as over waves, which therefore takes the place of max_error"

REFINED = {"radial": ("radial",), "bundler": ("focal", "radial")}
"""What models without refraction refine beside what the options say."""

LAND = "most of what the photographs show is land, which poses are taken from; the water is looked for afterwards"


class ReconstructionError(TorchrefracError, RuntimeError):
    """The photographs do not carry a reconstruction; the message says what is missing and what would help."""


def initializer_of(
    capture: Capture, ratio: float, options: Options, recorder: Recorder
) -> tuple[PoseInitializer, SfmOptions]:
    """Pose initialiser and SfM options of the model that was asked for.

    Without refraction a capture of unknown gravity is levelled by its optical axes: any frame is as good there.
    """
    sfm = options.sfm
    if options.model.name != "refractive" or ratio == 1.0:
        refine = tuple(name for name in sfm.bundle.refine if name in INTRINSICS)
        added = [name for name in REFINED.get(options.model.name, ()) if name != "radial" or "distortion" not in refine]
        refine = (*(name for name in refine if name not in added), *added)
        sfm = replace(sfm, bundle=replace(sfm.bundle, refine=refine))
    if options.model.name != "refractive":
        return PinholeInitializer(capture, sfm), sfm
    if ratio == 1.0:
        recorder.note("index ratio 1: there is no refraction to see the water by, so poses are those of a pinhole")
        return PinholeInitializer(capture, sfm), sfm
    make = PortInitializer if capture.interfaces.move_with_camera else RefractiveInitializer
    return make(capture, ratio, sfm), sfm


class Verified(NamedTuple):
    """The capture with gravity that can be used, the initialiser and its options, and what they verified."""

    capture: Capture
    initializer: PoseInitializer
    sfm: SfmOptions
    pairs: list[VerifiedPair]


@dataclass(frozen=True)
class Verification:
    """Which matches agree on a pose, of pairs of images."""

    matches: list[PairMatches]
    features: list[Features]
    ratio: float
    options: Options
    generator: torch.Generator
    recorder: Recorder
    work: Work

    def __call__(self, capture: Capture, gravity_is_measured: bool) -> Verified:
        """Once more where measured gravity cannot be right, with what takes its place."""
        found = self._with(capture)
        if gravity_is_measured and isinstance(found.initializer, RefractiveInitializer):
            parts = self.matches, found.pairs, self.features
            right = with_right_gravity(capture, *parts, self.ratio, found.sfm, self.recorder)
            found = found if right is capture else self._with(right)
            wide = RefractiveInitializer(found.capture, self.ratio, found.sfm.rough)
            if errors_are_rough(self.matches, found.pairs, self.features, wide):
                self.recorder.note(ROUGH)
                found = self._with(found.capture, rough=True)
        if not found.pairs:
            least, most = self.options.sfm.min_pair_inliers, max(len(pair) for pair in self.matches)
            raise ReconstructionError(
                f"no pair of images has {least} matches that agree on a pose (the best pair has {most} matches before "
                "the check); the photographs must show the same textured surface from nearby places"
            )
        return found

    def of_more(self, verified: Verified, matches: list[PairMatches]) -> list[VerifiedPair]:
        """Further pairs, verified as those before."""
        least = self.options.sfm.min_pair_inliers
        known = self.features, verified.initializer, least, self.generator, self.recorder, self.work
        return verify_pairs(matches, *known)

    def by_land(self, capture: Capture) -> Verified:
        """By pinhole poses: of photographs that show more land than water."""
        self.recorder.note(LAND)
        return self._with(capture, land=True)

    def _with(self, capture: Capture, rough: bool = False, land: bool = False) -> Verified:
        options = replace(self.options, sfm=self.options.sfm.rough) if rough else self.options
        initializer, sfm = initializer_of(capture, self.ratio, options, self.recorder)
        if land:
            initializer = PinholeInitializer(capture, sfm)
        least, chance = self.options.sfm.min_pair_inliers, self.generator
        pairs = verify_pairs(self.matches, self.features, initializer, least, chance, self.recorder, self.work)
        return Verified(capture, initializer, sfm, pairs)
