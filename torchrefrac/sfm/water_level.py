"""How high the water stands in the frame of an alignment, where nobody has measured it."""

from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.bundle import UnadjustableError
from torchrefrac.bundle.rows import IMPOSSIBLE_PX
from torchrefrac.files.water import Water
from torchrefrac.optim import robust
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Alignment, Survey
from torchrefrac.sfm.block import Block
from torchrefrac.sfm.readjust import ReadjustOptions, Work

AMONG_POINTS = (0.5, 0.75, 0.9)  # quantiles of the heights of points: land may stand above the water
ABOVE_POINTS = (0.1, 0.4, 0.7, 0.95)  # of the way from the highest points to the lowest camera
HIGHEST = 0.99
ITERATIONS = 15
AS_GOOD = 1.1


def find_offset(
    alignment: Alignment,
    water: Water,
    survey: Survey | None = None,
    options: ReadjustOptions | None = None,
    recorder: Recorder | None = None,
) -> float:
    """The offset of the one plane of `water`, of those tried, from which a short adjustment fits the images best; where
    several do about as well, that with which the cameras stay nearest to where they are.

    It is a start for an adjustment in which the height of the plane varies, or in which nothing fixes the scale of the
    cameras: about a plane that they have, cameras find their scale by themselves as long as the plane lies above what
    is under water. Raises UnadjustableError where no plane with this normal separates the cameras from most points.
    """
    options, recorder = options or ReadjustOptions(), recorder or SilentRecorder()
    bundle = options.bundle
    short = replace(bundle, solver=replace(bundle.solver, max_iterations=min(ITERATIONS, bundle.solver.max_iterations)))
    work = Work(alignment, survey or Survey.empty(alignment.names), replace(options, bundle=short))
    tried = candidate_offsets(alignment, water.normal[0]).tolist()
    costs, moved = [], []
    for offset in recorder.track(tried, len(tried), "water level", "height"):
        start = work.start(replace(water, offset=torch.tensor([offset], dtype=water.offset.dtype)))
        block, _ = work.adjust(start, work.first(start))
        costs.append(_cost(block, options.max_error))
        moved.append(float((block.state.center - alignment.center).norm(dim=-1).median()))
    good = [i for i, cost in enumerate(costs) if cost <= AS_GOOD * min(costs)]
    return tried[min(good, key=moved.__getitem__)]


def candidate_offsets(alignment: Alignment, normal: Tensor) -> Tensor:
    """Ascending, all below the lowest camera."""
    cameras, points = alignment.center @ normal, alignment.points @ normal
    if not len(points):
        raise UnadjustableError("the alignment has no points, between which and the cameras the water could stand")
    top, lowest = points.quantile(HIGHEST), cameras.min()
    if not bool(points.median() < lowest):
        raise UnadjustableError(
            "the cameras are not above the points along the normal of the plane, so that no water lies between; give "
            "the normal in the frame of the alignment, towards the cameras"
        )
    among = points.quantile(points.new_tensor(AMONG_POINTS))
    above = top + (lowest - top) * points.new_tensor(ABOVE_POINTS)
    every = torch.cat((among, above)) if bool(top < lowest) else among
    return every[every < lowest].sort().values


def _cost(block: Block, scale: float) -> float:
    """Of all observations, those of points without a position as if impossible."""
    return float(robust(block.errors().clamp(max=IMPOSSIBLE_PX).square(), "cauchy", scale)[0].sum())
