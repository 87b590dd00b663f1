"""What comes out when an alignment is adjusted anew."""

from dataclasses import dataclass, replace
from types import MappingProxyType

import torch
from torch import Tensor

from torchrefrac.bundle import BundleReport
from torchrefrac.files.water import Water
from torchrefrac.numerics import segment_sum
from torchrefrac.optim import Status
from torchrefrac.scene import Alignment, Assessment, Survey
from torchrefrac.sfm.assessment import assess
from torchrefrac.sfm.block import Block, unstacked


@dataclass(frozen=True)
class Readjusted:
    """The images that took part and the points that stayed, in the frame that was given, and the water.

    errors (N): reprojection errors of the observations, pixels; errors_before: through the water at the given poses, of
    all observations of points that could be triangulated from there. images (m): rows of the given alignment; shift
    (m): how far these cameras moved. unplaced: how many points could not be triangulated at the given poses. marks:
    adjusted positions by name. lost_marks and lost_images: what does not fit the rest. status: of the last adjustment.
    """

    alignment: Alignment
    water: Water
    errors: Tensor
    errors_before: Tensor
    images: Tensor
    shift: Tensor
    unplaced: int
    marks: dict[str, list[float]]
    lost_marks: tuple[str, ...]
    lost_images: tuple[str, ...]
    assessment: Assessment
    status: Status

    @classmethod
    def of(cls, given: Alignment, survey: Survey, start: Block, block: Block, report: BundleReport) -> "Readjusted":
        """From the blocks before and after; their points are those of `given`, then the marks of the survey."""
        ties, state, before = len(given.points), block.state, start.errors()
        stayed, marked = block.placed[:ties], block.placed[ties:].tolist()
        rows = (block.active & (block.seen.point < ties)).nonzero()[:, 0]
        adjusted = replace(
            given,
            lenses=unstacked(state.lens, given.lenses),
            rotation=state.rotation,
            center=state.center,
            points=state.points[:ties][stayed],
            colors=given.colors[stayed],
            image=block.seen.camera[rows],
            point=(stayed.cumsum(dim=0) - 1)[block.seen.point[rows]],
            pixels=block.seen.pixels[rows],
        ).of_images(block.images)
        positions = zip(survey.mark_names, state.points[ties:].tolist(), marked, strict=True)
        return cls(
            alignment=adjusted,
            water=_water(block, given),
            errors=block.errors()[rows],
            errors_before=before[before.isfinite()],
            images=block.images.nonzero()[:, 0],
            shift=(state.center - given.center).norm(dim=-1)[block.images],
            unplaced=int((~start.placed[:ties]).sum()),
            marks={name: position for name, position, there in positions if there},
            lost_marks=_lost(survey.mark_names, marked),
            lost_images=_lost(given.names, block.images.tolist()),
            assessment=assess(report.problem, report.state, report.held, len(adjusted.points)),
            status=report.status,
        )

    def point_errors(self) -> Tensor:
        """Mean reprojection error of each point (n), pixels."""
        n = len(self.alignment.points)
        total = segment_sum(self.errors[:, None], self.alignment.point, n)[:, 0]
        return total / torch.bincount(self.alignment.point, minlength=n)


def _lost(names: tuple[str, ...], kept: list[bool]) -> tuple[str, ...]:
    return tuple(name for name, there in zip(names, kept, strict=True) if not there)


def _water(block: Block, given: Alignment) -> Water:
    """The planes as they are now. plane_of tells of every image where there are several."""
    normal, offset = block.state.planes
    planes = dict(zip(given.names, block.links.plane.tolist(), strict=True)) if len(offset) > 1 else {}
    return Water(float(block.state.index_ratio), normal, offset, MappingProxyType(planes), given.length_unit)
