"""How high the water stands in the frame of a reconstruction, where nobody has measured it."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.bundle import UnadjustableError
from torchrefrac.bundle.rows import IMPOSSIBLE_PX
from torchrefrac.optim import robust
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Scene, Survey
from torchrefrac.sfm.outcome import Outcome
from torchrefrac.sfm.readjust import Work
from torchrefrac.sfm.rules import ReadjustOptions

AMONG_POINTS = (0.5, 0.75, 0.9)  # quantiles of the heights of points: land may stand above the water
ABOVE_POINTS = (0.1, 0.4, 0.7, 0.95)  # of the way from the highest points to the lowest camera
HIGHEST = 0.99
ITERATIONS = 15
AS_GOOD = 1.1


def with_found_level(
    scene: Scene, survey: Survey | None = None, options: ReadjustOptions | None = None, recorder: Recorder | None = None
) -> Scene:
    """The scene with its one surface at the height, of those tried, from which a short adjustment fits the images best;
    where several do about as well, that with which the cameras stay nearest to where they are.

    It is a start for an adjustment in which the height of the plane varies, or in which nothing fixes the scale of the
    cameras: about a plane that they have, cameras find their scale by themselves as long as the plane lies above what
    is under water. Raises UnadjustableError where no plane with this normal separates the cameras from most points.
    """
    options, recorder = options or ReadjustOptions(), recorder or SilentRecorder()
    tried = _tried_levels(scene, survey, options, recorder)
    costs = [misfit(adjusted, options.max_error) for _, adjusted in tried]
    moved = [float((after.views.center - scene.views.center).norm(dim=-1).median()) for _, after in tried]
    good = [i for i, cost in enumerate(costs) if cost <= AS_GOOD * min(costs)]
    return tried[min(good, key=moved.__getitem__)][0]


def at_best_level(scene: Scene, survey: Survey, options: ReadjustOptions) -> Scene:
    """The scene after a short adjustment from the height, of those tried, that then fits the images best. Raises what
    `with_found_level` raises."""
    tried = _tried_levels(scene, survey, options, SilentRecorder())
    return min((adjusted for _, adjusted in tried), key=lambda adjusted: misfit(adjusted, options.max_error))


def _tried_levels(
    scene: Scene, survey: Survey | None, options: ReadjustOptions, recorder: Recorder
) -> list[tuple[Scene, Scene]]:
    """The scene with its surface at each height that is tried, and what a short adjustment makes of it."""
    tried = [replace(scene, interfaces=replace(scene.interfaces, offset=at[None])) for at in candidate_offsets(scene)]
    every = survey or Survey.empty(scene.views.names)
    return [
        (candidate, short_adjustment(candidate, every, options)[0])
        for candidate in recorder.track(tried, len(tried), "water level", "height")
    ]


def short_adjustment(scene: Scene, survey: Survey, options: ReadjustOptions) -> tuple[Scene, Outcome]:
    """The first adjustment of `readjust`, of a few iterations."""
    bundle = options.bundle
    short = replace(bundle, solver=replace(bundle.solver, max_iterations=min(ITERATIONS, bundle.solver.max_iterations)))
    work = Work(scene, survey, replace(options, bundle=short), None)
    start = work.start(scene)
    return work.adjust(start, work.first(start))


def candidate_offsets(scene: Scene) -> Float[Tensor, " k"]:
    """Ascending, all below the lowest camera."""
    normal = scene.interfaces.normal[0]
    cameras, points = scene.views.center @ normal, scene.points @ normal
    if not len(points):
        raise UnadjustableError("the reconstruction has no points, between which and the cameras the water could stand")
    top, lowest = points.quantile(HIGHEST), cameras.min()
    if not bool(points.median() < lowest):
        raise UnadjustableError(
            "the cameras are not above the points along the normal of the plane, so that no water lies between; give "
            "the normal in the frame of the reconstruction, towards the cameras"
        )
    among = points.quantile(points.new_tensor(AMONG_POINTS))
    above = top + (lowest - top) * points.new_tensor(ABOVE_POINTS)
    every = torch.cat((among, above)) if bool(top < lowest) else among
    return every[every < lowest].sort().values


def misfit(scene: Scene, scale: float) -> float:
    """Of all observations, those of points without a position as if impossible."""
    return float(robust(scene.errors().clamp(max=IMPOSSIBLE_PX).square(), "cauchy", scale)[0].sum())
