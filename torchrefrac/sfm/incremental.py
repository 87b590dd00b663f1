"""The incremental loop: a pair with a sufficient baseline, then one image at a time (paper, section 3)."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count

import torch

from torchrefrac.bundle import BundleReport
from torchrefrac.checks import TorchrefracError
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, Reconstruction, Tracks
from torchrefrac.sfm.adjustment import Steps, adjust_model, assess_model
from torchrefrac.sfm.filtering import affordable_length, drop_unsupported_images, filter_points
from torchrefrac.sfm.frame import fix_frame
from torchrefrac.sfm.initial_pair import rank_initial_pairs, start_from_pair
from torchrefrac.sfm.model import SparseModel
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.pose import PoseInitializer
from torchrefrac.sfm.registration import register_image, visible_points
from torchrefrac.sfm.triangulation import triangulate_tracks
from torchrefrac.sfm.verification import VerifiedPair

MIN_INITIAL_POINTS = 12
MOST_SHOWN = 10_000  # points of a cloud that is still growing
GROWING = LevenbergMarquardtOptions(max_iterations=10, function_tolerance=1e-4)


class NoInitialPairError(TorchrefracError, RuntimeError):
    """No pair of images can start the reconstruction."""


def reconstruct_sparse(
    capture: Capture,
    tracks: Tracks,
    pairs: Sequence[VerifiedPair],
    initializer: PoseInitializer,
    options: SfmOptions,
    generator: torch.Generator,
    recorder: Recorder,
) -> Reconstruction:
    """Cameras and points from verified pairs and their tracks.

    Images that cannot be registered are listed in `failures` with the reason. Raises NoInitialPairError when there is
    nothing to start from.
    """
    growth = _Growth(capture, initializer, options, generator, recorder)
    model = growth.start(pairs, tracks)
    remaining = len(capture) - model.num_registered
    for grown in recorder.track(growth.register_all(model), remaining, "registering", "image"):
        model = grown
    model = growth.finish(model)
    with recorder.meter(1, "assessing", "") as advance:
        model = fix_frame(model, capture)
        growth.show(model)
        assessment = assess_model(model, capture, options.bundle, growth.held)
        advance(1, "")
    return replace(_to_reconstruction(model, capture, growth.failures), assessment=assessment)


class _Growth:
    """What all steps of one reconstruction share."""

    def __init__(
        self,
        capture: Capture,
        initializer: PoseInitializer,
        options: SfmOptions,
        generator: torch.Generator,
        recorder: Recorder,
    ) -> None:
        self.capture = capture
        self.initializer = initializer
        self.options = options
        self.generator = generator
        self.recorder = recorder
        self.failures: dict[str, str] = {}
        self.held: dict[str, str] = {}
        self._refused: dict[int, int] = {}  # images that could not be registered, and the points they saw then
        self._iterations, self._adjustments = count(), count()

    def start(self, pairs: Sequence[VerifiedPair], tracks: Tracks) -> SparseModel:
        for pair in rank_initial_pairs(pairs, self.options):
            model = start_from_pair(pair, tracks, self.capture, self.initializer.index_ratio, self.options)
            if int(model.has_point.sum()) < MIN_INITIAL_POINTS:
                continue
            model = self.adjust(model, GROWING)
            if int(model.has_point.sum()) >= MIN_INITIAL_POINTS:
                return model
        raise NoInitialPairError(
            f"none of {len(pairs)} image pairs has enough matches and angle to start from; "
            "take photographs that overlap more and are taken from further apart"
        )

    def register_all(self, model: SparseModel) -> Iterator[SparseModel]:
        """Yields the model after every image that could be registered."""
        adjusted_at = model.num_registered
        while True:
            seen = visible_points(model)
            seen[model.registered] = -1
            for image, at in self._refused.items():
                if seen[image] <= at:
                    seen[image] = -1
            best = int(seen.argmax())
            if int(seen[best]) < 0:
                return
            number_seen = int(seen[best])
            model, reason = register_image(model, best, self.initializer, self.options, self.generator)
            name = self.capture.names[best]
            if reason:
                self._refused[best] = number_seen
                self.failures[name] = reason
                self.recorder.detail(f"{name} is not registered: {reason}")
                continue
            self.failures.pop(name, None)
            agreeing = int((model.active & (model.tracks.image == best)).sum())
            self.recorder.scalar("registration/inliers", agreeing, model.num_registered)
            self.recorder.scalar("registration/inlier_ratio", agreeing / number_seen, model.num_registered)
            model = triangulate_tracks(model, self.options)
            if model.num_registered >= adjusted_at * self.options.global_growth:
                model = self.adjust(model, GROWING)
                adjusted_at = model.num_registered
            self.recorder.scalar("registration/images", model.num_registered, model.num_registered)
            self.recorder.scalar("registration/points", int(model.has_point.sum()), model.num_registered)
            yield model

    def adjust(self, model: SparseModel, solver: LevenbergMarquardtOptions) -> SparseModel:
        """Adjust, drop what no longer fits, and take in what now does."""
        bundle = replace(self.options.bundle, solver=solver)
        model, report = adjust_model(model, self.capture, bundle, self._record_step)
        self._record_adjustment(model, report)
        return triangulate_tracks(self._filter(model), self.options)

    def finish(self, model: SparseModel) -> SparseModel:
        """Adjust to convergence, with only the points that enough images see."""
        min_length = affordable_length(model, self.options)
        most = self.options.bundle.solver.max_iterations
        with self.recorder.meter(self.options.final_rounds * most, "adjusting", "") as advance:
            for _ in range(self.options.final_rounds):
                model = self._filter(triangulate_tracks(model, self.options), min_length)
                heard = Steps(self._record_step, most, advance)
                model, report = adjust_model(model, self.capture, self.options.bundle, heard)
                heard.end()
                self._record_adjustment(model, report)
                self.held = report.held
        return self._filter(model, min_length)

    def _filter(self, model: SparseModel, min_length: int = 2) -> SparseModel:
        """Drop points that do not fit, and images that are left with next to none."""
        model, lost = drop_unsupported_images(filter_points(model, self.options, min_length))
        if lost:
            model = filter_points(model, self.options, min_length)
        for image in lost:
            self.failures[self.capture.names[image]] = "lost its points when all images were adjusted together"
            self._refused[image] = int(visible_points(model)[image])
        return model

    def _record_step(self, iteration: int, cost: float, damping: float) -> None:
        step = next(self._iterations)
        self.recorder.scalar("adjustment/cost", cost, step)
        self.recorder.scalar("adjustment/damping", damping, step)

    def _record_adjustment(self, model: SparseModel, report: BundleReport) -> None:
        """What an adjustment of everything has led to."""
        self.recorder.detail(f"adjusted {model.num_registered} images: {report.summary()}")
        self.show(model, MOST_SHOWN)

    def show(self, model: SparseModel, most: int | None = None) -> None:
        """Residuals and points (of which at most this many), where anyone wants to see them."""
        if not self.recorder.wants_pictures:
            return
        step, tracks = next(self._adjustments), model.tracks
        self.recorder.histogram("residuals/px", model.errors()[model.active], step)
        ids = torch.unique_consecutive(tracks.track[model.active])
        ids = ids[:: 1 if most is None else max(-(-len(ids) // most), 1)]
        self.recorder.cloud("sparse", model.points[ids], tracks.mean_colors()[ids], step)


def _to_reconstruction(model: SparseModel, capture: Capture, failures: dict[str, str]) -> Reconstruction:
    tracks = model.tracks
    rows = model.active.nonzero()[:, 0]
    ids, point = torch.unique_consecutive(tracks.track[rows], return_inverse=True)
    return Reconstruction(
        names=capture.names,
        registered=model.registered,
        rotation=model.rotation,
        center=model.center,
        intrinsics=model.intrinsics,
        index_ratio=float(model.index_ratio),
        length_unit=capture.length_unit,
        points=model.points[ids],
        colors=tracks.mean_colors()[ids],
        image=tracks.image[rows],
        point=point,
        pixels=tracks.pixels[rows],
        failures=failures,
    )
