"""The stages of a reconstruction as plain functions: photographs in, cameras and points out."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchrefrac.bundle.rows import INTRINSICS
from torchrefrac.checks import TorchrefracError
from torchrefrac.commands.densify import dense_stage
from torchrefrac.commands.pairs import choose_pairs, require_pairs
from torchrefrac.commands.photographs import extract, match_pairs
from torchrefrac.commands.run_folder import RunFolder
from torchrefrac.commands.survey_products import require_place, require_surface
from torchrefrac.config import Options, WaterOptions
from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.evaluate.doubts import doubts
from torchrefrac.evaluate.land import land_difference
from torchrefrac.evaluate.metrics import evaluate_run
from torchrefrac.evaluate.survey_consistency import position_contradictions
from torchrefrac.evaluate.survey_metrics import survey_metrics
from torchrefrac.features import Features, PairMatches, build_tracks
from torchrefrac.figures.matches import StagePictures
from torchrefrac.files.paths import real_path
from torchrefrac.files.run import WORK
from torchrefrac.files.survey import SURVEY, read_survey
from torchrefrac.files.swap import home
from torchrefrac.files.work import Work
from torchrefrac.parallel import Workers
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Capture, CaptureError, Scene, Survey, SurveyError, Truth, WarningCode, with_measured
from torchrefrac.sfm import (
    PinholeInitializer,
    PortInitializer,
    PoseInitializer,
    RefractiveInitializer,
    SfmOptions,
    UnknownVerticalError,
    VerifiedPair,
    better_focal,
    check_levels,
    complete_gravity,
    errors_are_rough,
    errors_in_air_and_water,
    facing_wall,
    fits_better_in_air,
    level_capture,
    reconstruct_sparse,
    verify_pairs,
    with_likely_focals,
    with_right_gravity,
    with_upright_wall,
)

ROUGH = "clearly more matches agree within sfm.rough_error, as over waves, which therefore takes the place of max_error"

LAND = "most of what the photographs show is land, which poses are taken from; the water is looked for afterwards"

StageHook = Callable[[str, Any, float], None]


class ReconstructionError(TorchrefracError, RuntimeError):
    """The photographs do not carry a reconstruction; the message says what is missing and what would help."""


def reconstruct(
    capture: Capture,
    options: Options | None = None,
    recorder: Recorder | None = None,
    on_stage: StageHook | None = None,
    survey: Survey | None = None,
    work: Work | None = None,
) -> Scene:
    """Reconstruct cameras and sparse points of a capture.

    survey: what was measured on site, by default what the file `options.survey` says, or the survey.json beside the
    capture.json, if there is one; `Survey.empty(capture.names)` for none. work: where long work is done, and where its
    parts are left for a run that goes on from there; by default in this process, and nowhere.

    `on_stage(name, product, seconds)` hears of every finished stage: "features" (list of Features), "pairs"
    (ChosenPairs, which are matched; a part of matching), "levelling" (the capture with estimated verticals; only where
    gravity of any image is unknown and refraction can show it), "matching" (list of VerifiedPair), "sparse" (Scene).
    Deterministic for given options. Raises ReconstructionError when no two images can be related, or no pair shows
    which way is down; OptionError, CaptureError and SurveyError for what `options` name and cannot be used.
    """
    options = options or Options()
    survey = survey or survey_of(capture, options)
    capture = _prepared(capture, survey)
    require_pairs(capture, options.matching)
    recorder, work = recorder or SilentRecorder(), work or Work()
    stage = _Stages(on_stage)
    generator = torch.Generator().manual_seed(options.seed)

    features = stage("features", lambda: extract(capture, options, recorder, work))
    matches = stage.part("matching", lambda: _matched(capture, features, options, recorder, stage, work))
    ratio, stated = options.water.ratio_of(capture.index_ratio), capture
    if options.model.name == "refractive" and ratio > 1.0 and not capture.interfaces.move_with_camera:
        known = matches, features, ratio, options.sfm
        capture = stage.part("matching", lambda: with_likely_focals(stated, *known))
        given = capture
        if bool(given.down_sigma.isinf().any()):
            level = complete_gravity if given.has_gravity else level_capture
            try:
                capture = stage("levelling", lambda: with_upright_wall(level(given, *known, recorder)))
            except UnknownVerticalError as error:
                raise ReconstructionError(str(error)) from None
    verify = _Verification(matches, features, ratio, options, generator, recorder, work)
    levelled = capture
    verified = stage.part("matching", lambda: verify(levelled, stated.has_gravity))
    stage("matching", lambda: verified.pairs)

    water = ratio if options.model.name == "refractive" else 1.0

    def grown(verified: _Verified) -> Scene:
        observations, colors = build_tracks(features, [pair.pair for pair in verified.pairs])
        recorder.scalar("tracks/count", len(colors), 0)
        recorder.scalar("tracks/observations", len(observations), 0)
        recorder.histogram("tracks/length", torch.bincount(observations.point), 0)
        scene = Scene.of_capture(verified.capture, observations, colors, verified.initializer.index_ratio)
        capture, initializer, sfm, pairs = verified
        about = water, features, survey
        return reconstruct_sparse(scene, capture, pairs, initializer, sfm, generator, recorder, *about)

    def sparse() -> Scene:
        found = grown(verified)
        if found.assessment.surface_slope > 0.0 and stated.has_gravity:  # land looks like that, too
            against = {finding.code for finding in contradictions(found, stated)}
            if against == {WarningCode.SURFACE_NOT_FLAT} and fits_better_in_air(found, stated):
                found = grown(verify.by_land(levelled))
        known = replace(found.assessment, water_stated=ratio if found.index_ratio <= 1.0 < water else None)
        if found.index_ratio <= 1.0:
            known = replace(known, in_air_and_water=errors_in_air_and_water(found, stated))
        elif (
            found.interfaces.stand_in_world
            and (focal := better_focal(found, replace(stated, cameras=found.cameras), matches, features, verified.sfm))
            is not None
        ):
            known = replace(known, wished={"focal": focal})
        place = stated.georeference or survey.georeference if known.lowered_by is not None else None
        above = place and place.raised(known.lowered_by or 0.0, known.slope)
        found = replace(found, assessment=known, georeference=above)
        about_positions = position_contradictions(found, known.surveyed, known.lowered_by)
        return replace(found, findings=(*contradictions(found, stated), *about_positions, *doubts(stated)))

    return stage("sparse", sparse)


def _prepared(capture: Capture, survey: Survey) -> Capture:
    """The capture with what was measured on site, in the frame of what it looks through."""
    if len(capture.interfaces) > 1:
        raise CaptureError(
            f"{capture.folder / 'capture.json'} has {len(capture.interfaces)} interfaces, whose photographs known "
            "points alone relate: find their poses by torchrefrac calibrate capture=DIR"
        )
    capture = facing_wall(with_measured(capture, survey))
    check_levels(survey, capture)
    return capture


def run(
    capture: Capture,
    options: Options,
    recorder: Recorder,
    folder: Path,
    about: Mapping[str, Any] | None = None,
    truth: Truth | None = None,
) -> dict[str, Any]:
    """Reconstruct, make it dense where that is asked for, evaluate where the truth is known, and leave everything in
    `folder`. Returns the metrics, which begin with those of `about` (such as the name of the scene).

    Each stage's files are written when it ends. When a stage fails or is interrupted, metrics.json says which, why, and
    what was complete before; when the same is run again it goes on with the photographs, pairs and dense views that
    were finished.
    """
    survey = survey_of(capture, options)
    require_place(options.outputs, capture.georeference or survey.georeference)
    if options.outputs.for_surveys:
        require_surface(capture.interfaces)
    files, pictures = RunFolder(folder), StagePictures(capture, recorder)
    gravity = with_measured(capture, survey).gravity_metrics

    def stage_done(name: str, product: Any, seconds: float) -> None:
        files.stage_done(name, product, seconds)
        pictures.stage_done(name, product)

    known = {"model": options.model.name, "capture": str(real_path(capture.folder))} | dict(about or {})
    with Workers(options.executor) as workers, files.recording(**known, **gravity):
        work = Work(workers, home(folder) / WORK)
        scene = reconstruct(capture, options, recorder, stage_done, survey, work)
        with recorder.meter(2, "evaluating", "") as advance:
            metrics, alignment = evaluate_run(scene, truth)
            lowered = scene.assessment.lowered_by or 0.0
            metrics |= survey_metrics(scene.assessment.surveyed, scene.length_unit, lowered)
            advance(1, "")
            files.complete(scene, metrics, truth, alignment)
            advance(1, "")
        if options.compare_land and scene.interfaces.stand_in_world:
            recorder.note("the same without refraction, to compare the land")
            in_air = replace(options, water=WaterOptions(index_ratio=1.0))
            files.metrics |= land_difference(scene, reconstruct(capture, in_air, recorder, survey=survey, work=work))
        if options.dense.method != "none":
            dense_stage(files, scene, options.dense, options.outputs, truth, alignment, recorder)
        work.clear()
    return files.metrics


def survey_of(capture: Capture, options: Options) -> Survey:
    """What was measured on site: in the file that the options name, or else beside the capture."""
    beside = capture.folder / SURVEY
    path = options.survey or (beside if beside.is_file() else None)
    if path is None:
        return Survey.empty(capture.names)
    survey = read_survey(path, capture.names, capture.georeference)
    if survey.georeference is not None and capture.length_unit != "m":
        raise SurveyError(
            f"{path} has positions on a map, in m, but lengths of the capture are in {capture.length_unit}"
        )
    return survey


class _Stages:
    """Times each stage and tells the hook."""

    def __init__(self, hook: StageHook | None) -> None:
        self._hook = hook
        self._seconds: Counter[str] = Counter()

    def part(self, name: str, work: Callable[[], Any]) -> Any:
        """Work that belongs to a stage which is not yet finished by it."""
        start = time.perf_counter()
        product = work()
        self._seconds[name] += time.perf_counter() - start  # type: ignore[assignment]
        return product

    def __call__(self, name: str, work: Callable[[], Any]) -> Any:
        product = self.part(name, work)
        if self._hook is not None:
            self._hook(name, product, self._seconds[name])
        return product


def _matched(
    capture: Capture, features: list[Features], options: Options, recorder: Recorder, stage: _Stages, work: Work
) -> list[PairMatches]:
    """Matches of those pairs that are worth it."""
    chosen = choose_pairs(capture, features, options.matching, options.seed)
    stage("pairs", lambda: chosen)
    return match_pairs(features, chosen, options.matching, recorder, work)


def _initializer(
    capture: Capture, ratio: float, options: Options, recorder: Recorder
) -> tuple[PoseInitializer, SfmOptions]:
    """Pose initialiser and SfM options of the model that was asked for.

    Without refraction a capture of unknown gravity is levelled by its optical axes: any frame is as good there.
    """
    sfm = options.sfm
    if options.model.name != "refractive" or ratio == 1.0:
        refine = tuple(name for name in sfm.bundle.refine if name in INTRINSICS)
        if options.model.name == "radial" and "distortion" not in refine:
            refine = (*(name for name in refine if name != "radial"), "radial")
        sfm = replace(sfm, bundle=replace(sfm.bundle, refine=refine))
    if options.model.name != "refractive":
        return PinholeInitializer(capture, sfm), sfm
    if ratio == 1.0:
        recorder.note("index ratio 1: there is no refraction to see the water by, so poses are those of a pinhole")
        return PinholeInitializer(capture, sfm), sfm
    make = PortInitializer if capture.interfaces.move_with_camera else RefractiveInitializer
    return make(capture, ratio, sfm), sfm


class _Verified(NamedTuple):
    """The capture with gravity that can be used, the initialiser and its options, and what they verified."""

    capture: Capture
    initializer: PoseInitializer
    sfm: SfmOptions
    pairs: list[VerifiedPair]


@dataclass(frozen=True)
class _Verification:
    """Which matches agree on a pose, of pairs of images."""

    matches: list[PairMatches]
    features: list[Features]
    ratio: float
    options: Options
    generator: torch.Generator
    recorder: Recorder
    work: Work

    def __call__(self, capture: Capture, gravity_is_measured: bool) -> _Verified:
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

    def by_land(self, capture: Capture) -> _Verified:
        """By pinhole poses: of photographs that show more land than water."""
        self.recorder.note(LAND)
        return self._with(capture, land=True)

    def _with(self, capture: Capture, rough: bool = False, land: bool = False) -> _Verified:
        options = replace(self.options, sfm=self.options.sfm.rough) if rough else self.options
        initializer, sfm = _initializer(capture, self.ratio, options, self.recorder)
        if land:
            initializer = PinholeInitializer(capture, sfm)
        least, chance = self.options.sfm.min_pair_inliers, self.generator
        pairs = verify_pairs(self.matches, self.features, initializer, least, chance, self.recorder, self.work)
        return _Verified(capture, initializer, sfm, pairs)
