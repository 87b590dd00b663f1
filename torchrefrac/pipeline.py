"""The stages of a reconstruction as plain functions: photographs in, cameras and points out."""

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import torch

from torchrefrac.config import Options
from torchrefrac.features import Features, PairMatches, build_tracks, extract_sift, match
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.report.metrics import evaluate, summarize
from torchrefrac.report.run_folder import RunFolder
from torchrefrac.scene import Capture, Reconstruction, load_truth
from torchrefrac.sfm import (
    PinholeInitializer,
    PoseInitializer,
    RefractiveInitializer,
    SfmOptions,
    VerifiedPair,
    reconstruct_sparse,
    verify_pairs,
)

StageHook = Callable[[str, Any, float], None]


class ReconstructionError(RuntimeError):
    """The photographs do not carry a reconstruction; the message says what is missing and what would help."""


def reconstruct(
    capture: Capture,
    options: Options | None = None,
    recorder: Recorder | None = None,
    on_stage: StageHook | None = None,
) -> Reconstruction:
    """Reconstruct cameras and sparse points of a capture.

    `on_stage(name, product, seconds)` hears of every finished stage: "features" (list of Features), "matching" (list of
    VerifiedPair), "sparse" (Reconstruction). Deterministic for given options. Raises ReconstructionError when no two
    images can be related.
    """
    options = options or Options()
    recorder = recorder or SilentRecorder()
    stage = _Stages(on_stage)
    generator = torch.Generator().manual_seed(options.seed)
    initializer, sfm = _initializer(capture, options, recorder)

    features = stage("features", lambda: _extract(capture, options, recorder))
    pairs = stage("matching", lambda: _match(features, initializer, options, generator, recorder))
    tracks = build_tracks(features, [pair.pair for pair in pairs])
    return stage(
        "sparse",
        lambda: reconstruct_sparse(capture, tracks, pairs, initializer, sfm, generator, recorder),
    )


def run(capture: Capture, options: Options, recorder: Recorder, folder: Path) -> dict[str, Any]:
    """Reconstruct, evaluate where truth is at hand, and leave everything in `folder`. Returns the metrics.

    Each stage's files are written when it ends. When a stage fails or is interrupted, metrics.json says which, why, and
    what was complete before.
    """
    files = RunFolder(folder)
    with files.recording(model=options.model.name, capture=str(capture.folder.resolve())):
        reconstruction = reconstruct(capture, options, recorder, files.stage_done)
        metrics = summarize(reconstruction)
        truth = load_truth(capture.folder)
        aligned = None
        if truth is not None:
            measured, aligned = evaluate(reconstruction, truth)
            metrics |= measured
        files.complete(reconstruction, metrics, truth, aligned)
        recorder.cloud("sparse", reconstruction.points, reconstruction.colors, 0)
    return files.metrics


class _Stages:
    """Times each stage and tells the hook."""

    def __init__(self, hook: StageHook | None) -> None:
        self._hook = hook

    def __call__(self, name: str, work: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        product = work()
        if self._hook is not None:
            self._hook(name, product, time.perf_counter() - start)
        return product


def _initializer(capture: Capture, options: Options, recorder: Recorder) -> tuple[PoseInitializer, SfmOptions]:
    """Pose initialiser and SfM options of the model that was asked for."""
    sfm = replace(options.sfm, bundle=replace(options.sfm.bundle, refine_radial=options.model.name == "radial"))
    ratio = options.water.ratio_of(capture.index_ratio)
    if options.model.name != "refractive":
        return PinholeInitializer(capture, sfm), sfm
    if ratio == 1.0:
        recorder.note("index ratio 1: there is no refraction to see the water by, so poses are those of a pinhole")
        return PinholeInitializer(capture, sfm), sfm
    return RefractiveInitializer(capture, torch.tensor(ratio, dtype=torch.float64), sfm), sfm


def _extract(capture: Capture, options: Options, recorder: Recorder) -> list[Features]:
    paths = recorder.track(capture.paths, len(capture), "features", "image")
    return [extract_sift(path, options.features) for path in paths]


def _match(
    features: list[Features],
    initializer: PoseInitializer,
    options: Options,
    generator: torch.Generator,
    recorder: Recorder,
) -> list[VerifiedPair]:
    every = list(combinations(range(len(features)), 2))
    pairs = [
        PairMatches(i, j, match(features[i].descriptors, features[j].descriptors, options.matching))
        for i, j in recorder.track(every, len(every), "matching", "pair")
    ]
    least = options.sfm.min_pair_inliers
    verified = verify_pairs(pairs, features, initializer, least, generator, recorder)
    if not verified:
        most = max(len(pair) for pair in pairs)
        raise ReconstructionError(
            f"no pair of images has {least} matches that agree on a pose (the best pair has {most} matches before "
            "the check); the photographs must show the same textured surface from nearby places"
        )
    return verified
