"""The stages of a reconstruction as plain functions: photographs in, cameras and points out."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.commands.densify import dense_stage
from torchrefrac.commands.pairs import FILE, ChosenPairs, choose_pairs, require_pairs
from torchrefrac.commands.photographs import extract, made_elsewhere, match_pairs, sizes_of
from torchrefrac.commands.run_folder import RunFolder
from torchrefrac.commands.sparse import SparseStage
from torchrefrac.commands.survey_products import require_place, require_surface
from torchrefrac.commands.verification import ReconstructionError, Verification
from torchrefrac.config import Options, WaterOptions
from torchrefrac.evaluate.land import land_difference
from torchrefrac.evaluate.metrics import evaluate_run
from torchrefrac.evaluate.survey_metrics import survey_metrics
from torchrefrac.features import Features, MadeElsewhereOptions, PairMatches
from torchrefrac.figures.matches import StagePictures
from torchrefrac.files.paths import real_path
from torchrefrac.files.run import WORK
from torchrefrac.files.survey import SURVEY, read_survey
from torchrefrac.files.swap import home
from torchrefrac.files.work import Work
from torchrefrac.parallel import Workers
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Capture, CaptureError, Scene, Survey, SurveyError, Truth, with_measured
from torchrefrac.sfm import (
    UnknownVerticalError,
    check_levels,
    complete_gravity,
    facing_wall,
    level_capture,
    uncalibrated,
    with_likely_focals,
    with_upright_wall,
)

StageHook = Callable[[str, Any, float], None]


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
    if options.model.name == "bundler":
        capture = uncalibrated(capture)
    require_pairs(capture, options.matching)
    recorder, work = recorder or SilentRecorder(), work or Work()
    stage = _Stages(on_stage)
    generator = torch.Generator().manual_seed(options.seed)

    features, matches = _matched(capture, options, recorder, stage, work)
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
    verify = Verification(matches, features, ratio, options, generator, recorder, work)
    levelled = capture
    verified = stage.part("matching", lambda: verify(levelled, stated.has_gravity))
    stage("matching", lambda: verified.pairs)

    return stage("sparse", SparseStage(verify, verified, stated, levelled, survey))


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
    files, pictures = RunFolder(folder, options.colmap), StagePictures(capture, recorder)
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
            dense_stage(files, scene, options.dense, options.outputs, truth, alignment, recorder, workers)
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
    capture: Capture, options: Options, recorder: Recorder, stage: _Stages, work: Work
) -> tuple[list[Features], list[PairMatches]]:
    """Keypoints, and matches of those pairs that are worth it, or both as another program made them."""
    how = options.features
    if isinstance(how, MadeElsewhereOptions):
        features, matches = stage.part("features", lambda: made_elsewhere(capture, how, recorder, work))
        stage("features", lambda: features)
        pairs = torch.tensor([(pair.first, pair.second) for pair in matches])
        stage("pairs", lambda: ChosenPairs(pairs, FILE, len(capture)))
        return features, matches
    features = stage("features", lambda: extract(capture, options, recorder, work))
    chosen = stage.part("matching", lambda: choose_pairs(capture, features, options.matching, options.seed))
    stage("pairs", lambda: chosen)
    matching = options.matching, recorder, work, options.device, sizes_of(capture)
    return features, stage.part("matching", lambda: match_pairs(features, chosen, *matching))
