"""The growth of one reconstruction: a pair with a sufficient baseline, then one view at a time (paper, section 3)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchrefrac.bundle import GravityPrior, HeightPrior, Term
from torchrefrac.checks import TorchrefracError
from torchrefrac.features import Features
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, Part, Scene, Survey
from torchrefrac.sfm.adjust import (
    Journal,
    Steps,
    adjust,
    adjust_locally,
    assess_scene,
    common_tilt,
    ending_early,
    with_errors_found,
    with_height,
    with_neighbours,
    with_noise_found,
    with_slope,
)
from torchrefrac.sfm.complete_tracks import complete_tracks
from torchrefrac.sfm.dry_points import disputed, find_dry, same_dry, stated_sides, with_dry
from torchrefrac.sfm.filter_points import affordable_length, filter_points
from torchrefrac.sfm.frame import final_frame, fix_frame, with_water_at_zero
from torchrefrac.sfm.gravity import worst_gravity
from torchrefrac.sfm.land import flooded
from torchrefrac.sfm.levels import with_levels, with_surfaces
from torchrefrac.sfm.outcome import Outcome
from torchrefrac.sfm.pose import PoseInitializer
from torchrefrac.sfm.register import MIN_INITIAL_POINTS, rank_initial_pairs, register_each, start, visible_points
from torchrefrac.sfm.rules import Rules, SfmOptions
from torchrefrac.sfm.stated_levels import StatedLevels
from torchrefrac.sfm.survey_frame import SurveyFrame, placed_by_survey
from torchrefrac.sfm.triangulate import triangulate
from torchrefrac.sfm.verification import VerifiedPair

MOST_SHOWN = 10_000  # points of a cloud that is still growing
GROWING = LevenbergMarquardtOptions(max_iterations=10, function_tolerance=1e-4)
NEARLY = 0.75
"""Times the points that the best view sees, with which others are registered in one round with it."""
EVERYTHING, FEWEST = 4, 6
"""Of the adjustments of many images that grow, every so many are of everything, the others of the views that joined
and of their neighbours, so many at least."""


class NoInitialPairError(TorchrefracError, RuntimeError):
    """No pair of images can start the reconstruction."""


@dataclass(frozen=True)
class Given:
    """What all reconstructions of one capture are made from; see `reconstruct_sparse`. seed: of their random samples.
    survey: with what the capture states."""

    capture: Capture
    options: SfmOptions
    initializer: PoseInitializer
    seed: int
    recorder: Recorder
    water: float
    features: Sequence[Features]
    survey: Survey


class Growth:
    """The order of the steps of one reconstruction, and what they share."""

    def __init__(self, given: Given) -> None:
        self.given = given
        self.capture, self.options, self.recorder = given.capture, given.options, given.recorder
        self.rules = self.options.rules(given.initializer, self.measured, given.seed)
        self.final = self.rules  # with the noise and the errors that the last adjustment has shown
        self.down_sigma = self.capture.down_sigma  # infinite where gravity turns out to be wrong
        self.frame: SurveyFrame | None = None
        self.slopes = False
        self.failures: dict[str, str] = {}
        self.fixed: dict[str, str] = {}
        self.stopped_after: int | None = None
        self._refused = torch.full((len(self.capture),), -1)  # points that views saw when they could not be registered
        self.journal = Journal(self.recorder)

    @property
    def in_place(self) -> bool:
        """Whether the scene stands in the frame of the survey."""
        return self.frame is not None and self.frame.level is not None

    def measured(self, part: Part) -> Sequence[Term]:
        """Gravity where there is something to see the vertical by, and the survey, once the scene is in its frame."""
        terms: list[Term] = []
        if part.scene.interfaces.stand_in_world or self.in_place:
            up = None if self.frame is None else self.frame.used.up
            terms.append(GravityPrior(self.capture.down_in_cam[part.view], self.down_sigma[part.view], up=up))
        if part.scene.interfaces.has_layers:  # whose thickness is in the unit of the capture
            rows = self.capture.has_height[part.view].nonzero()[:, 0]
            which = part.view[rows]
            terms.append(HeightPrior(rows, self.capture.height[which], self.capture.height_sigma[which]))
        return terms if self.frame is None else [*terms, *self.frame.terms(part)]

    def grow(self, empty: Scene, pairs: Sequence[VerifiedPair], among: Bool[Tensor, " m"]) -> Scene:
        """From one of the pairs to as many views of those `among` as can be registered. Raises NoInitialPairError."""
        return self.go_on(self.start(empty, pairs), among)

    def go_on(self, scene: Scene, among: Bool[Tensor, " m"]) -> Scene:
        """With as many more views of those `among` as can be registered."""
        remaining = int((among & ~scene.views.registered).sum())
        for grown in self.recorder.track(self.register_all(scene, among), remaining, "registering", "image"):
            scene = grown
        return scene

    def start(self, empty: Scene, pairs: Sequence[VerifiedPair]) -> Scene:
        for pair in rank_initial_pairs(pairs, self.options):
            scene, outcome = start(empty, pair, self.rules)
            if not outcome.done:
                continue
            scene = self.adjust(scene)
            if int(scene.placed.sum()) >= MIN_INITIAL_POINTS:
                return scene
        raise NoInitialPairError(
            f"none of {len(pairs)} image pairs has enough matches and angle to start from; "
            "take photographs that overlap more and are taken from further apart"
        )

    def register_all(self, scene: Scene, among: Bool[Tensor, " m"]) -> Iterator[Scene]:
        """Yields the scene for every view `among` some that could be registered, after the round in which it was."""
        adjusted_at, rounds = scene.views.num_registered, 0
        joined = torch.zeros_like(scene.views.registered)
        while len(views := self._next_views(scene, among)):
            before = scene.views.registered
            scene = self._register(scene, views.tolist())
            new = scene.views.registered & ~before
            if not bool(new.any()):
                continue
            scene, _ = triangulate(scene, self.rules, scene.seen_by(new) & ~scene.placed)
            joined, registered = joined | new, scene.views.num_registered
            if registered >= adjusted_at * self.options.global_growth:
                rounds = rounds + 1 if registered >= self.options.many_images else 0
                scene = self.adjust(scene, joined if rounds % EVERYTHING else None)
                adjusted_at, joined = scene.views.num_registered, torch.zeros_like(joined)
            self.recorder.scalar("registration/images", scene.views.num_registered, registered)
            self.recorder.scalar("registration/points", int(scene.placed.sum()), registered)
            yield from [scene] * int(new.sum())

    def _next_views(self, scene: Scene, among: Bool[Tensor, " m"]) -> Int[Tensor, " k"]:
        """Those that see most points, of the views that see more than when they were refused: one, or where there are
        many those that see nearly as many as the first, and no more than call for an adjustment together."""
        seen = visible_points(scene)
        left = among & ~scene.views.registered & (seen > self._refused)
        order = torch.where(left, seen, -1).argsort(descending=True, stable=True)
        registered = scene.views.num_registered
        most = int((self.options.global_growth - 1.0) * registered) if registered >= self.options.many_images else 1
        several = left & (seen >= NEARLY * seen[order[0]])
        return order[: min(max(most, 1), int(several.sum()))]

    def _register(self, scene: Scene, views: Sequence[int]) -> Scene:
        """With more views, but those that have no pose."""
        registered = scene.views.num_registered
        scene, outcomes = register_each(scene, views, self.rules)
        for view, outcome in zip(views, outcomes, strict=True):
            seen, name = int(outcome.numbers["seen"]), scene.views.names[view]
            if not outcome.done:
                self._refused[view] = seen
                self.failures[name] = str(outcome)
                self.recorder.detail(f"{name} is not registered: {outcome}")
                continue
            self.failures.pop(name, None)
            registered, agreeing = registered + 1, outcome.numbers["agreeing"]
            self.recorder.scalar("registration/inliers", agreeing, registered)
            self.recorder.scalar("registration/inlier_ratio", agreeing / seen, registered)
        return scene

    def take_in(self, scene: Scene, among: Bool[Tensor, " m"]) -> Scene:
        """What views and points of another reconstruction have joined: adjusted as one, and with as many more views of
        those `among` as can be registered now."""
        for view in scene.views.registered.nonzero()[:, 0].tolist():
            self.failures.pop(scene.views.names[view], None)
        scene = self.adjust(scene)
        return self.go_on(scene, among) if bool((among & ~scene.views.registered).any()) else scene

    def adjust(self, scene: Scene, joined: Bool[Tensor, " m"] | None = None) -> Scene:
        """Adjust, drop what no longer fits, and take in what now does. joined: views that are adjusted with their
        neighbours, the others staying as they are; by default everything is."""
        growing = replace(self.rules, bundle=replace(self.rules.bundle, solver=GROWING))
        if joined is None:
            scene, outcome = adjust(scene, growing, self.journal.step)
        else:
            some = with_neighbours(scene, joined, FEWEST)
            scene, outcome = adjust_locally(scene, growing, some, self.journal.step)
        self._record(scene, outcome)
        return triangulate(self._filter(scene, self.rules), self.rules)[0]

    def finished(self, scene: Scene) -> Scene:
        """The scene as it comes out, with its assessment."""
        scene = self.finish(scene)
        with self.recorder.meter(1, "assessing", "") as advance:
            scene = scene if self.in_place else fix_frame(scene, self.capture, self.frame is not None)
            self.show(scene)
            rules = self.final
            assessment = assess_scene(scene, rules, self.fixed)
            sides = self.sides(scene)
            if sides is not None:
                assessment = replace(assessment, disputed=disputed(scene, rules, sides))
            if self.frame is not None:
                within = torch.zeros_like(scene.placed).index_fill(0, scene.part().point, True)
                scene, surveyed = self.frame.parted(replace(scene, assessment=assessment.spread_over(within)))
                assessment = replace(assessment.of_points(torch.arange(len(scene.part().point))), surveyed=surveyed)
            assessment = with_levels(assessment, scene, rules, self.fixed)
            advance(1, "")
        assessment = replace(assessment, stopped_after=self.stopped_after)
        if self.frame is not None:
            assessment = replace(assessment, lowered_by=self.frame.level, up=self.frame.used.up)
        return replace(scene.trimmed(), failures=self.failures, assessment=assessment)

    def finish(self, scene: Scene) -> Scene:
        """Adjust to convergence, with only the points that enough views see; and again without the gravity of views
        that the others contradict, for as long as there are such; without any if most are contradicted."""
        scene = self._complete(scene)
        if scene.views.num_registered >= self.options.many_images:
            self.rules = replace(self.rules, bundle=ending_early(self.rules.bundle))
        length = affordable_length(scene, self.rules, self.options.min_track_length)
        rules = replace(self.rules, min_track_length=length)
        scene = self._converged(scene, rules)
        for _ in range(self.options.final_rounds if scene.interfaces.stand_in_world else 0):
            wrong = worst_gravity(scene, self.capture.down_in_cam, self.down_sigma)
            if bool(wrong.any()):  # unless errors that observations have in common explain it
                sigma = torch.hypot(self.down_sigma, common_tilt(scene, self.final, self.fixed))
                wrong = worst_gravity(scene, self.capture.down_in_cam, sigma)
            if not bool(wrong.any()):
                break
            unknown = wrong | self.down_sigma.isinf()
            most = 2 * int((unknown & scene.views.registered).sum()) > scene.views.num_registered
            self.down_sigma = torch.where(unknown | most, torch.inf, self.down_sigma)
            scene = self._converged(scene, rules)
        scene = self._with_survey(scene, length)
        scene = self._with_epochs(self._with_water(scene, length), length)
        scene = self._with_stated_levels(scene, length)
        return self._with_dry(scene, replace(self._needing(length), max_error=self.final.max_error))

    def _with_survey(self, scene: Scene, length: int) -> Scene:
        """Adjusted with what was surveyed, the height of the water among it being what images say."""
        found = placed_by_survey(scene, self.capture, self.given.survey, self.final.bundle.pixel_sigma)
        if found is None:
            return scene
        scene, self.frame = found
        if scene.interfaces.stand_in_world and self.in_place:
            self.rules = replace(self.rules, bundle=with_height(self.rules.bundle))
        return self._at_zero(self._converged(scene, self._needing(length)))

    def _needing(self, length: int) -> Rules:
        """Rules by which a point needs so many observations, unless it is a ground control point."""
        lengths = length if self.frame is None else self.frame.lengths(length)
        return replace(self.rules, min_track_length=lengths)

    def _with_water(self, scene: Scene, length: int) -> Scene:
        """A scene of land with the water beside it, where there is any."""
        if self.given.water <= 1.0 or scene.interfaces.refract():
            return scene
        level = scene if self.in_place else fix_frame(scene, self.capture, self.frame is not None)
        found = flooded(level, self.given.water, self.final)
        if found is None:
            return scene
        if self.in_place:
            self.rules = replace(self.rules, bundle=with_height(self.rules.bundle))
        return self._at_zero(self._converged(self._at_zero(found), self._needing(length)))

    def _with_epochs(self, scene: Scene, length: int) -> Scene:
        """With a water surface of its own, at a level of its own, for each epoch."""
        if len(self.capture.epochs) < 2 or not scene.interfaces.stand_in_world:
            return scene
        self.rules = replace(self.rules, bundle=with_height(self.rules.bundle))
        each = with_surfaces(scene, self.capture.epoch)
        return self._at_zero(self._converged(each, self._needing(length)))

    def _with_stated_levels(self, scene: Scene, length: int) -> Scene:
        """Adjusted with the levels of the water that the survey states, too, unless the rest contradicts them."""
        if self.frame is None or not self.in_place or not len(self.frame.stated.level):
            return scene
        sigma = assess_scene(scene, self.final, self.fixed).level_sigma
        if sigma is None or not scene.interfaces.stand_in_world:
            return scene
        levels = StatedLevels.of(self.frame.stated, scene)
        agree = levels.agree_with(levels.at_interfaces(scene), sigma[levels.surface])
        if levels.show_slope(scene):
            in_plane = levels.agree_on_slope(scene, sigma)
            self.slopes = levels.show_slope(scene, in_plane)
            agree = in_plane if self.slopes else agree & in_plane
        if not bool(agree.any()):
            return scene
        self.frame = self.frame.with_levels(agree)
        if self.slopes:
            self.rules = replace(self.rules, bundle=with_slope(self.rules.bundle))
        return self._at_zero(self._converged(scene, self._needing(length)))

    def _at_zero(self, scene: Scene) -> Scene:
        """With the water at z = 0, and the survey likewise."""
        if not scene.interfaces.stand_in_world:
            return scene
        if self.frame is not None and self.slopes:
            self.frame, scene = self.frame.with_water_at_zero(scene)
            return scene
        scene, by = with_water_at_zero(scene)
        self.frame = self.frame and self.frame.lowered(by)
        return scene

    def _with_dry(self, scene: Scene, rules: Rules) -> Scene:
        """With those points seen straight that are, and everything adjusted to that, until no more are found."""
        for _ in range(self.options.final_rounds):
            dry = find_dry(scene, rules, self.sides(scene))
            if same_dry(dry, scene.dry):
                break
            scene = self._at_zero(self._converged(with_dry(scene, dry), rules))
        return scene

    def sides(self, scene: Scene) -> Int[Tensor, " n"] | None:
        """On which side of the border of the water the points lie, where one is stated."""
        extent = self.capture.water_extent
        if extent is None:
            return None
        final = None if self.in_place else final_frame(scene, self.capture, self.frame is not None)
        return stated_sides(scene, extent, final)

    def _converged(self, scene: Scene, rules: Rules) -> Scene:
        """Points and observations judged and everything adjusted, in turn, until little changes any more: roughly at
        first, as what comes of that changes the weights."""
        most, rounds = rules.bundle.solver.max_iterations, self.options.final_rounds
        with self.recorder.meter(rounds * most, "adjusting", "") as advance:
            for number in range(1, rounds + 1):
                scene = self._filter(triangulate(scene, rules)[0], rules)
                steps = Steps(self.journal.step, most, advance)
                rough = number == 1 < rounds
                now = replace(rules, bundle=ending_early(rules.bundle, GROWING.function_tolerance)) if rough else rules
                scene, outcome = adjust(scene, now, steps)
                steps.end()
                self._record(scene, outcome)
                if outcome.report is not None:
                    rules = replace(rules, bundle=with_noise_found(self.rules.bundle, outcome.report))
                    rules = with_errors_found(rules, outcome.report, self.options.least_error)
        self.final = replace(self.rules, bundle=rules.bundle, max_error=rules.max_error)
        return self._filter(scene, rules)

    def _complete(self, scene: Scene) -> Scene:
        """With more observations of the points, also of those that two views see, now that all poses are known."""
        if not self.given.features:
            return scene
        completed = complete_tracks(scene, self.given.features, self.options.max_error)
        return self._filter(triangulate(completed, self.rules)[0], self.rules)

    def _filter(self, scene: Scene, rules: Rules) -> Scene:
        """Drop points that do not fit, and views that are left with next to none."""
        scene, outcome = filter_points(scene, rules)
        for view in outcome.views:
            self.failures[scene.views.names[view]] = "lost its points when all images were adjusted together"
            self._refused[view] = int(visible_points(scene)[view])
        return scene

    def _record(self, scene: Scene, outcome: Outcome) -> None:
        """What an adjustment has led to."""
        if outcome.report is not None:
            self.fixed, self.stopped_after = outcome.report.fixed, outcome.report.stopped_after
            self.recorder.detail(f"adjusted {len(outcome.report.scene.views)} images: {outcome.report.summary()}")
        self.show(scene, MOST_SHOWN)

    def show(self, scene: Scene, most: int | None = None) -> None:
        """The accepted points (of which at most this many), where anyone wants to see them."""
        ids = torch.unique_consecutive(scene.observations.point[scene.accepted])
        self.journal.show("sparse", scene, ids, most)
