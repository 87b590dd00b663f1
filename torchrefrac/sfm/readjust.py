"""The other order of the verbs: a scene that was reconstructed, with or without refraction, adjusted with the water."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.bundle import BundleOptions, HeightPrior, Term, UnadjustableError, check_inputs
from torchrefrac.numerics import on_device
from torchrefrac.recorder import Advance, Recorder, SilentRecorder
from torchrefrac.scene import Assessment, Part, Scene, Survey
from torchrefrac.scene.capture import RELATIVE_HEIGHT_SIGMA
from torchrefrac.sfm.adjust import Journal, Steps, adjust, assess, with_height, with_slope
from torchrefrac.sfm.control import check_vertical, survey_terms, with_control
from torchrefrac.sfm.dry_points import find_dry, with_dry
from torchrefrac.sfm.filter_points import filter_points
from torchrefrac.sfm.outcome import Outcome
from torchrefrac.sfm.positions import FEWEST, without_contradicted
from torchrefrac.sfm.rules import ReadjustOptions
from torchrefrac.sfm.stated_levels import StatedLevels
from torchrefrac.sfm.triangulate import triangulate

MOST_SHOWN = 50_000  # points of a cloud for the recorder
GENEROUS = 3.0  # what an error may be, in medians of all, while poses may still be far off
LOOSE = 1e3  # times their sigmas positions do little more than fix the frame
FIRST = ("plane_tilt", "plane_height")  # may vary at once; intrinsics and index ratio would take up errors of the poses


def readjust(
    scene: Scene, survey: Survey | None = None, options: ReadjustOptions | None = None, recorder: Recorder | None = None
) -> tuple[Scene, Outcome]:
    """Adjust `scene` with refraction at its interfaces and the measurements of `survey`.

    Points are triangulated through the water: those given may be of a reconstruction without refraction. A first
    adjustment, in which large errors count little, takes in everything and leaves index ratio and intrinsics. Then
    observations that do not fit are dropped, points that could not be placed are tried again, and everything is
    adjusted, up to `options.rounds` times. Stated positions, of cameras and ground control, that most others contradict
    are left out; the outcome has the survey that was used. Where it states levels, the heights of interfaces vary. What
    nothing fixes of the frame stays as near to the given one as the data allow.

    The ground control points of the survey are the last points of the result (placed where they fit); views and
    points that do not fit the rest are still in it, not registered and not placed. The numbers of the outcome are
    "not_triangulated", of points at the given poses, and "median_before", the reprojection error there (pixels).

    Raises UnadjustableError, with the names of the images, for cameras below the water and for images that no common
    points connect, at the start or among what fits; SurveyError where gravity is measured and z does not point up.
    """
    stated = survey or Survey.empty(scene.views.names)
    options, recorder = options or ReadjustOptions(), recorder or SilentRecorder()
    if stated.level_sources:
        slopes = StatedLevels.of(stated, scene).show_slope(scene)
        options = replace(options, bundle=(with_slope if slopes else with_height)(options.bundle))
    with recorder.meter(1, "placing", "") as advance:
        work = Work(scene, _most_positions(scene, stated, options), options, recorder)
        first = work.start(scene)
        before = first.errors()
        advance(1, "")
    adjusted, outcome = work.adjust_all(first)
    with recorder.meter(1, "assessing", "") as advance:
        assert outcome.report is not None
        report = outcome.report
        assessment = on_device(assess(report.problem, report.scene, report.fixed), adjusted.points.device)
        assessment = assessment.spread_over(adjusted.placed)
        assessment = replace(assessment, stopped_after=report.stopped_after, up=stated.up)
        advance(1, "")
    missing, median = int((~first.placed[: work.ties]).sum()), float(before[before.isfinite()].median())
    outcome = replace(outcome, numbers={"not_triangulated": missing, "median_before": median}, survey=work.survey)
    return replace(adjusted, assessment=assessment), outcome


def _most_positions(scene: Scene, stated: Survey, options: ReadjustOptions) -> Survey:
    """The survey without the positions that most others contradict. An adjustment in which positions do little more
    than fix the frame finds them: at full weight they win against images, whose large errors count little."""
    if len(stated.center) + len(stated.known_control) <= FEWEST or options.held == "cameras":
        return stated
    work = Work(scene, stated.loosened(LOOSE), options, None)
    first = work.start(scene)
    return without_contradicted(work.adjust(first, work.first(first))[0], stated)


class Work:
    """The steps of one adjustment, and what they share."""

    def __init__(self, scene: Scene, survey: Survey, options: ReadjustOptions, recorder: Recorder | None) -> None:
        if len(scene.views) < 2:
            raise UnadjustableError(f"the reconstruction has {len(scene.views)} image(s), but an adjustment needs two")
        check_vertical(scene, survey)
        self.survey, self.options, self.ties = survey, options, len(scene.points)
        self.recorder = recorder or SilentRecorder()
        glazed = scene.interfaces.has_layers and scene.interfaces.stand_in_world and not survey.has_lengths
        self.heights = scene.camera_heights() if glazed else None
        self.known = torch.zeros(self.ties + len(survey.control_names), dtype=torch.bool)
        self.known[self.ties + survey.known_control] = True
        self.rules = options.rules(self._measured, 2 - self.known.long())
        self.journal, self._adjustments = Journal(self.recorder), count()

    def start(self, scene: Scene) -> Scene:
        """All views; points triangulated through the water at their poses, and ground control points after them."""
        scene = with_control(replace(scene, assessment=Assessment()), self.survey)
        self._check(replace(scene, placed=torch.ones_like(scene.placed), accepted=torch.ones_like(scene.accepted)))
        everything = replace(self.rules, max_error=torch.inf, min_support=0)
        scene, _ = triangulate(scene, everything, torch.ones_like(scene.placed))
        scene, _ = filter_points(replace(scene, placed=scene.placed | self.known), everything)
        if not bool(scene.accepted.any()):
            raise UnadjustableError(
                f"none of {self.ties} points can be triangulated through the water; the planes must be given in the "
                "frame of the reconstruction"
            )
        return scene

    def adjust_all(self, scene: Scene) -> tuple[Scene, Outcome]:
        """The first adjustment, and all rounds after it."""
        options = self.options
        self._note_dry(scene)
        most = options.bundle.solver.max_iterations
        with self.recorder.meter((1 + options.rounds) * most, "adjusting", "") as advance:
            scene, outcome = self.adjust(scene, self.first(scene), advance)
            for i in range(options.rounds):
                last = i == options.rounds - 1
                before, limit = scene, options.max_error if last else self._generous(scene)
                scene = self._with_dry(scene) if last else scene
                rules = replace(self.rules, max_error=limit)
                doubtful = self._doubtful(scene, limit)
                doubtful[self.ties :] &= ~scene.placed[self.ties :]  # control points are where measurements have them
                scene, _ = triangulate(scene, rules, doubtful)
                scene, _ = filter_points(scene, rules)
                if i == 0 or not outcome.done or not _same_parts(scene, before):
                    scene, outcome = self.adjust(scene, options.bundle, advance)
                else:
                    advance(most, "")
        return scene, outcome

    def _with_dry(self, scene: Scene) -> Scene:
        """With those points seen straight that are, unless it is known which; control points stay where they are."""
        if scene.dry is not None:
            return scene
        found = with_dry(scene, find_dry(scene, self.rules))
        return replace(found, placed=found.placed | (scene.placed & self.known))

    def first(self, scene: Scene) -> BundleOptions:
        """How the first adjustment is done."""
        refine = tuple(name for name in self.options.bundle.refine if name in FIRST)
        return replace(self.options.bundle, loss="cauchy", loss_scale=self._generous(scene), refine=refine)

    def adjust(self, scene: Scene, bundle: BundleOptions, advance: Advance | None = None) -> tuple[Scene, Outcome]:
        """All that takes part. `advance` moves a meter, in all by the number of iterations that there may be."""
        self._check(scene)
        steps = Steps(self.journal.step, bundle.solver.max_iterations, advance or (lambda count, text: None))
        scene, outcome = adjust(scene, replace(self.rules, bundle=bundle), steps)
        steps.end()
        self._record(scene, outcome)
        return scene, outcome

    def _measured(self, part: Part) -> Sequence[Term]:
        terms = survey_terms(self.survey, part, self.ties)
        return terms if self.heights is None else [*terms, self._scale(part)]

    def _scale(self, part: Part) -> HeightPrior:
        """Layers of known thickness determine the scale, but so weakly that it would drift: it is known to
        RELATIVE_HEIGHT_SIGMA, as that of one stated height, and each single height to much less."""
        assert self.heights is not None
        heights = self.heights[part.view]
        sigma = RELATIVE_HEIGHT_SIGMA * len(heights) ** 0.5 * heights
        return HeightPrior(torch.arange(len(heights)), heights, sigma)

    def _record(self, scene: Scene, outcome: Outcome) -> None:
        """What an adjustment has led to."""
        registered, report = scene.views.num_registered, outcome.report
        self.recorder.detail(f"adjusted {registered} images: {report.summary() if report else outcome}")
        step, ties = next(self._adjustments), scene.placed[: self.ties].nonzero()[:, 0]
        self.recorder.scalar("adjustment/images", registered, step)
        self.recorder.scalar("adjustment/points", len(ties), step)
        self.journal.show("points", scene, ties, MOST_SHOWN)

    def _check(self, scene: Scene) -> None:
        """Refuse what cannot be adjusted. A control point that a single view sees does no harm, but ties nothing."""
        shared, view, _ = scene.part(min_observations=2)
        fixed = torch.ones(len(view), 6, dtype=torch.bool) if self.rules.fixed_poses else None
        located = torch.zeros_like(scene.views.registered).index_fill(0, self.survey.center_image, True)
        check_inputs(shared, fixed, located=located[view])

    def _generous(self, scene: Scene) -> float:
        error = scene.errors()[scene.accepted]
        return max(self.options.max_error, GENEROUS * float(error[error.isfinite()].median()))

    def _doubtful(self, scene: Scene, limit: float) -> Bool[Tensor, " n"]:
        """Points without a position, or with an error above the limit in a registered view."""
        seen = scene.observations
        beyond = scene.views.registered[seen.view] & (scene.errors() >= limit)
        return ~scene.placed | (torch.bincount(seen.point[beyond], minlength=len(scene.points)) > 0)

    def _note_dry(self, scene: Scene) -> None:
        ties = scene.placed[: self.ties]
        dry = int((scene.above_water()[: self.ties] & ties).sum())
        if 2 * dry > int(ties.sum()) and scene.interfaces.stand_in_world:
            self.recorder.note(
                f"{dry} of {int(ties.sum())} points lie above the water, where nothing refracts: is the plane given "
                "in the frame of the reconstruction?"
            )


def _same_parts(scene: Scene, other: Scene) -> bool:
    """Whether the same views, points and observations take part."""
    masks = ((of.views.registered, of.placed, of.accepted) for of in (scene, other))
    return all(torch.equal(mine, its) for mine, its in zip(*masks, strict=True))
