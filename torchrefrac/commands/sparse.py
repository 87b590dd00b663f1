"""From verified pairs to the finished sparse scene, and what its images say against what was stated."""

from dataclasses import dataclass, replace

import torch

from torchrefrac.commands.pairs import ChosenPairs, pairs_left_out
from torchrefrac.commands.photographs import match_pairs, sizes_of
from torchrefrac.commands.verification import Verification, Verified
from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.evaluate.doubts import doubts
from torchrefrac.evaluate.survey_consistency import position_contradictions
from torchrefrac.features import MadeElsewhereOptions, PairMatches, build_tracks
from torchrefrac.features.matching import WAYS
from torchrefrac.scene import Capture, Scene, Survey, WarningCode
from torchrefrac.sfm import (
    better_focal,
    errors_in_air_and_water,
    fits_better_in_air,
    reconstruct_sparse,
)


@dataclass(frozen=True)
class SparseStage:
    """Views and points of a capture: `stated` as it was given, `levelled` as it was verified."""

    verify: Verification
    verified: Verified
    stated: Capture
    levelled: Capture
    survey: Survey

    def __call__(self) -> Scene:
        stated, found = self.stated, self._with_left_out(self._grown(self.verified))
        if found.assessment.surface_slope > 0.0 and stated.has_gravity:  # land looks like that, too
            against = {finding.code for finding in contradictions(found, stated)}
            if against == {WarningCode.SURFACE_NOT_FLAT} and fits_better_in_air(found, stated):
                found = self._grown(self.verify.by_land(self.levelled))
        further = (self._assessed(one).of_views(one.views.registered) for one in found.further)
        found = replace(self._assessed(found), further=tuple(further))
        known = found.assessment
        about_positions = position_contradictions(found, known.surveyed, known.lowered_by)
        return replace(found, findings=(*contradictions(found, stated), *about_positions, *doubts(stated)))

    @property
    def _water(self) -> float:
        """Index ratio of what may be beside the land."""
        return self.verify.ratio if self.verify.options.model.name == "refractive" else 1.0

    def _grown(self, verified: Verified) -> Scene:
        verify, recorder = self.verify, self.verify.recorder
        observations, colors = build_tracks(verify.features, [pair.pair for pair in verified.pairs])
        recorder.scalar("tracks/count", len(colors), 0)
        recorder.scalar("tracks/observations", len(observations), 0)
        recorder.histogram("tracks/length", torch.bincount(observations.point), 0)
        scene = Scene.of_capture(verified.capture, observations, colors, verified.initializer.index_ratio)
        capture, initializer, sfm, pairs = verified
        about = self._water, verify.features, self.survey
        return reconstruct_sparse(scene, capture, pairs, initializer, sfm, verify.generator, recorder, *about)

    def _with_left_out(self, found: Scene) -> Scene:
        """The same with photographs that no pair had joined, after these were matched with all others."""
        more = self._matched_again(found)
        pairs = self.verify.of_more(self.verified, more) if more else []
        if not pairs:
            return found
        again = self._grown(self.verified._replace(pairs=[*self.verified.pairs, *pairs]))
        return again if again.views.num_registered > found.views.num_registered else found

    def _matched_again(self, found: Scene) -> list[PairMatches]:
        """Matches of photographs that are not registered with all that they were not matched with, unless a file lists
        the pairs."""
        verify = self.verify
        given = isinstance(verify.options.features, MadeElsewhereOptions) or verify.options.matching.pairs not in WAYS
        if given or bool(found.views.registered.all()):
            return []
        tried = torch.tensor([(pair.first, pair.second) for pair in verify.matches])
        left = pairs_left_out(tried, found.views.registered)
        if not len(left):
            return []
        lost = len(found.views) - found.views.num_registered
        verify.recorder.note(f"{lost} images are not registered; they are matched with others, too")
        chosen = ChosenPairs(left, "what is missing", len(found.views))
        options, sizes = verify.options, sizes_of(self.stated)
        how = options.matching, verify.recorder, verify.work, options.device, sizes
        return match_pairs(verify.features, chosen, *how)

    def _assessed(self, found: Scene) -> Scene:
        """With what images say of what was stated, and where the scene stands on the map."""
        stated, ratio, verify = self.stated, self.verify.ratio, self.verify
        known = replace(found.assessment, water_stated=ratio if found.index_ratio <= 1.0 < self._water else None)
        if found.index_ratio <= 1.0:
            known = replace(known, in_air_and_water=errors_in_air_and_water(found, stated))
        elif found.interfaces.stand_in_world:
            given = replace(stated, cameras=found.cameras)
            focal = better_focal(found, given, verify.matches, verify.features, self.verified.sfm)
            known = known if focal is None else replace(known, wished={"focal": focal})
        place = stated.georeference or self.survey.georeference if known.lowered_by is not None else None
        above = place and place.raised(known.lowered_by or 0.0, known.slope)
        return replace(found, assessment=known, georeference=above)
