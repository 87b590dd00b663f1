"""An existing alignment, made with or without refraction, adjusted anew with the water in it."""

from dataclasses import dataclass, field, replace
from itertools import count
from typing import Literal

import torch
from torch import Tensor

from torchrefrac.bundle import BundleOptions, BundleReport, UnadjustableError, adjust, check_inputs
from torchrefrac.checks import require
from torchrefrac.files.water import Water
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.recorder import Advance, Recorder, SilentRecorder
from torchrefrac.scene import Alignment, Survey
from torchrefrac.sfm.adjustment import Steps
from torchrefrac.sfm.block import Block
from torchrefrac.sfm.filtering import MIN_OBSERVATIONS
from torchrefrac.sfm.marks import check_vertical, known_marks, survey_terms, with_marks
from torchrefrac.sfm.readjusted import Readjusted

MOST_SHOWN = 50_000  # points of a cloud for the recorder
GENEROUS = 3.0  # what an error may be, in medians of all, while poses may still be far off
FIRST = ("plane_tilt", "plane_height")  # may vary at once; lenses and index ratio would take up the errors of the poses


@dataclass(frozen=True)
class ReadjustOptions:
    """max_error: of an observation that is kept, pixels. rounds: of dropping observations and adjusting again. held:
    "cameras" keeps the poses as they are."""

    held: Literal["none", "cameras"] = "none"
    max_error: float = 4.0
    rounds: int = 3
    bundle: BundleOptions = field(
        default_factory=lambda: BundleOptions(
            loss_scale=0.5, pixel_sigma=0.5, solver=LevenbergMarquardtOptions(max_iterations=100)
        )
    )

    def __post_init__(self) -> None:
        require(self.max_error, "max_error", above=0.0)
        require(self.rounds, "rounds", at_least=1)


def readjust(
    alignment: Alignment,
    water: Water,
    survey: Survey | None = None,
    options: ReadjustOptions | None = None,
    recorder: Recorder | None = None,
) -> Readjusted:
    """Adjust `alignment` with refraction at the planes of `water` and the measurements of `survey`.

    Points are triangulated anew through the water: those given may be of a reconstruction without refraction. A first
    adjustment, in which large errors count little, takes in everything and holds index ratio and lenses. Then
    observations that do not fit are dropped, points that could not be placed are tried again, and everything is
    adjusted, up to `options.rounds` times. What nothing fixes of the frame stays as near to the given one as the data
    allow.

    Raises UnadjustableError, with the names of the images, for cameras below the water and for images that no common
    points connect, at the start or among what fits; SurveyError where gravity is measured and z does not point up.
    """
    work = Work(alignment, survey or Survey.empty(alignment.names), options or ReadjustOptions(), recorder)
    with work.recorder.meter(1, "placing", "") as advance:
        start = work.start(water)
        advance(1, "")
    block, report = work.adjust_all(start)
    with work.recorder.meter(1, "assessing", "") as advance:
        result = Readjusted.of(alignment, work.survey, start, block, report)
        advance(1, "")
    return result


class Work:
    """The steps of one adjustment, and what they share."""

    def __init__(
        self, alignment: Alignment, survey: Survey, options: ReadjustOptions, recorder: Recorder | None = None
    ) -> None:
        if len(alignment) < 2:
            raise UnadjustableError(f"the alignment has {len(alignment)} image(s), but an adjustment needs two")
        check_vertical(alignment, survey)
        self.alignment, self.survey, self.options = alignment, survey, options
        self.recorder = recorder or SilentRecorder()
        self._iterations, self._adjustments = count(), count()

    @property
    def ties(self) -> int:
        """How many points are not marks."""
        return len(self.alignment.points)

    def start(self, water: Water) -> Block:
        """All images; points triangulated through the water at their poses."""
        known = torch.cat((torch.zeros(self.ties, dtype=torch.bool), known_marks(self.survey)))
        block = Block.of(with_marks(self.alignment, self.survey), water, least=2 - known.long())
        self._check(replace(block, placed=torch.ones_like(block.placed)))
        block = block.with_places(~block.placed, self.options.bundle.pixel_sigma, self.options.max_error)
        block = replace(block, placed=block.placed | known).within(torch.inf)
        if not bool(block.active.any()):
            raise UnadjustableError(
                f"none of {self.ties} points can be triangulated through the water; the planes must be given in the "
                "frame of the alignment"
            )
        return block

    def adjust_all(self, block: Block) -> tuple[Block, BundleReport]:
        """The first adjustment, and all rounds after it."""
        options = self.options
        self._tell_dry(block)
        most = options.bundle.solver.max_iterations
        with self.recorder.meter((1 + options.rounds) * most, "adjusting", "") as advance:
            block, report = self.adjust(block, self.first(block), advance)
            support = 0 if options.held == "cameras" else MIN_OBSERVATIONS
            for i in range(options.rounds):
                before, limit = block, options.max_error if i == options.rounds - 1 else self._generous(block)
                anew = block.doubtful(limit)
                anew[self.ties :] &= ~block.placed[self.ties :]  # a mark is where measurements have it
                block = block.with_places(anew, options.bundle.pixel_sigma, options.max_error, limit)
                block = block.within(limit, support)
                if i == 0 or report.status != "converged" or not block.same_parts_as(before):
                    block, report = self.adjust(block, options.bundle, advance)
                else:
                    advance(most, "")
        return block, report

    def first(self, block: Block) -> BundleOptions:
        """How the first adjustment is done."""
        refine = tuple(name for name in self.options.bundle.refine if name in FIRST)
        return replace(self.options.bundle, loss="cauchy", loss_scale=self._generous(block), refine=refine)

    def adjust(self, block: Block, bundle: BundleOptions, advance: Advance | None = None) -> tuple[Block, BundleReport]:
        """All that takes part. `advance` moves a meter, in all by the number of iterations that there may be."""
        self._check(block)
        heard = Steps(self._record_step, bundle.solver.max_iterations, advance or (lambda count, text: None))
        selection = block.select()
        image, mark = _slots(block.images, selection.image), _slots(block.placed, selection.point)[self.ties :]
        report = adjust(
            selection.state,
            selection.seen,
            bundle,
            links=selection.links,
            terms=survey_terms(self.survey, image, mark, block.links.plane),
            held=self._held(len(selection.image)),
            check=False,
            callback=heard,
        )
        heard.end()
        block = block.with_state(report.state, selection)
        self._record(block, report)
        return block, report

    def _record_step(self, iteration: int, cost: float, damping: float) -> None:
        step = next(self._iterations)
        self.recorder.scalar("adjustment/cost", cost, step)
        self.recorder.scalar("adjustment/damping", damping, step)

    def _record(self, block: Block, report: BundleReport) -> None:
        """What an adjustment has led to."""
        self.recorder.detail(f"adjusted {int(block.images.sum())} images: {report.summary()}")
        step, ties = next(self._adjustments), block.placed[: self.ties].nonzero()[:, 0]
        self.recorder.scalar("adjustment/images", int(block.images.sum()), step)
        self.recorder.scalar("adjustment/points", len(ties), step)
        if not self.recorder.wants_pictures:
            return
        self.recorder.histogram("residuals/px", block.errors()[block.active], step)
        ties = ties[:: max(-(-len(ties) // MOST_SHOWN), 1)]
        self.recorder.cloud("points", block.state.points[ties], self.alignment.colors[ties], step)

    def _check(self, block: Block) -> None:
        """Refuse what cannot be adjusted. A mark that a single image sees does no harm, but ties nothing."""
        shared = block.shared()
        names = [self.alignment.names[i] for i in shared.image.tolist()]
        check_inputs(shared.state, shared.seen, shared.links, self._held(len(names)), names)

    def _held(self, cameras: int) -> Tensor | None:
        return torch.ones(cameras, 6, dtype=torch.bool) if self.options.held == "cameras" else None

    def _generous(self, block: Block) -> float:
        error = block.errors()[block.active]
        return max(self.options.max_error, GENEROUS * float(error[error.isfinite()].median()))

    def _tell_dry(self, block: Block) -> None:
        ties = block.placed[: self.ties]
        dry = int((block.above_water()[: self.ties] & ties).sum())
        if 2 * dry > int(ties.sum()) and float(block.state.index_ratio) > 1.0:
            self.recorder.note(
                f"{dry} of {int(ties.sum())} points lie above the water, where nothing refracts: is the plane given "
                "in the frame of the alignment?"
            )


def _slots(mask: Tensor, ids: Tensor) -> Tensor:
    """The number among `ids` of each element of the mask; -1 for those that are not there."""
    slots = torch.full(mask.shape, -1, dtype=torch.long)
    slots[ids] = torch.arange(len(ids))
    return slots
