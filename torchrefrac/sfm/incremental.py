"""The incremental loop: a pair with a sufficient baseline, then one image at a time (paper, section 3)."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count

import torch

from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, Reconstruction, Tracks
from torchrefrac.sfm.adjustment import adjust_model, assess_model
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
GROWING = LevenbergMarquardtOptions(max_iterations=10, function_tolerance=1e-4)


class NoInitialPairError(RuntimeError):
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
    model = fix_frame(model, capture)
    assessment = assess_model(model, capture, options.bundle, growth.held)
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
        self._iterations = count()

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
            if reason:
                self._refused[best] = number_seen
                self.failures[self.capture.names[best]] = reason
                continue
            self.failures.pop(self.capture.names[best], None)
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
        model, _ = adjust_model(model, self.capture, bundle, self._record_cost)
        return triangulate_tracks(self._filter(model), self.options)

    def finish(self, model: SparseModel) -> SparseModel:
        """Adjust to convergence, with only the points that enough images see."""
        min_length = affordable_length(model, self.options)
        rounds = range(self.options.final_rounds)
        for _ in self.recorder.track(rounds, len(rounds), "adjusting", "round"):
            model = self._filter(triangulate_tracks(model, self.options), min_length)
            model, report = adjust_model(model, self.capture, self.options.bundle, self._record_cost)
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

    def _record_cost(self, iteration: int, cost: float) -> None:
        self.recorder.scalar("adjustment/cost", cost, next(self._iterations))


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
