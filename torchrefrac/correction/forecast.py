"""How wrong corrected points are expected to be, where the poses come from an alignment without water.

Such an alignment takes up refraction in its poses as well as it can, which no correction of single points mends. What
that costs is found by playing it through: for a bed under water, cameras see its points through the water, an
adjustment without water moves poses and points until the straight rays meet, and the cameras are put back onto their
positions. The bed is changed until that gives the apparent points of the cloud. Then it is compared with the corrected
points. Points above the water take part, and hold the poses where there are any.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.bundle import UnadjustableError
from torchrefrac.camera import Intrinsics
from torchrefrac.correction.points import correct_points
from torchrefrac.correction.rules import CorrectionRules
from torchrefrac.geometry import Rigid, align_similarity
from torchrefrac.numerics import thin
from torchrefrac.scene import Cameras, Interfaces, Observations, Scene, Survey, Viewpoints
from torchrefrac.sfm import ReadjustOptions, readjust
from torchrefrac.sfm.frame import transformed

MOST_CAMERAS, MOST_POINTS = 12, 100  # that take part: a place in the middle of a large survey stands for it
FEWEST_CAMERAS, FEWEST_POINTS, FEWEST_VIEWS = 3, 20, 3
FOCAL = 1000.0  # px, of the cameras that stand for those of the cloud
ROUNDS = 4  # of changing the bed
LOOSE = 0.5  # of the errors found: how far the apparent points may be missed after that
WITHOUT_WATER = ReadjustOptions(max_error=1e3, rounds=1)


@dataclass(frozen=True)
class Forecast:
    """Root mean square distances from where points are expected to be: left, of corrected points; before, of the
    apparent ones. depth: root mean square of where they are expected."""

    left: float
    before: float
    depth: float


def forecast_errors(
    points: Float[Tensor, "n 3"],
    level: Float[Tensor, " n"],
    wet: Bool[Tensor, " n"],
    viewpoints: Viewpoints,
    rules: CorrectionRules,
) -> Forecast | None:
    """Of some apparent points, as `correct_points` takes them; None where cameras are not calibrated, too few points or
    cameras take part, or no bed gives these points."""
    known = viewpoints.rotation is not None and viewpoints.field is not None
    if not known or rules.index_ratio == 1.0 or not bool(wet.any()):
        return None
    level = level.where(wet, level[wet].mean())
    rows = (wet | (points[:, 2] >= level)).nonzero()[:, 0]  # what lies lower beside the water is no bed
    points, level, wet = points[rows], level[rows], wet[rows]
    viewpoints = _around_the_busiest(points, viewpoints, level)
    seen = viewpoints.see(points[:, None] - viewpoints.center)
    rows = (seen.sum(dim=-1) >= FEWEST_VIEWS).nonzero()[:, 0]
    rows = thin(rows, MOST_POINTS)
    points, level, wet, seen = points[rows], level[rows], wet[rows], seen[rows]
    corrected = correct_points(points, level, wet, viewpoints, rules)
    which = corrected.corrected
    if len(viewpoints) < FEWEST_CAMERAS or int(which.sum()) < FEWEST_POINTS:
        return None
    mean = torch.cat((viewpoints.center[:, :2].mean(dim=0), level.mean()[None]))
    lowered = torch.stack((torch.zeros_like(level), torch.zeros_like(level), level - mean[2]), dim=-1)
    viewpoints = replace(viewpoints, center=viewpoints.center - mean)
    given, better = points - mean - lowered, corrected.points - mean - lowered
    try:
        bed, missed = _bed(given, better, seen, viewpoints, rules.index_ratio)
    except UnadjustableError:
        return None
    left, before, rest = (_rms(values[which]) for values in (better - bed, given - bed, missed))
    if not rest <= LOOSE * max(left, before):
        return None
    return Forecast(left, before, float(bed[which, 2].square().mean().sqrt()))


def _around_the_busiest(points: Float[Tensor, "n 3"], viewpoints: Viewpoints, level: Float[Tensor, " n"]) -> Viewpoints:
    """Of calibrated cameras above the water the one that sees most of the points, and those around it."""
    assert viewpoints.field is not None
    usable = viewpoints[viewpoints.field.isfinite().all(dim=-1) & (viewpoints.center[:, 2] > level.max())]
    if not len(usable):
        return usable
    busiest = int(usable.see(points[:, None] - usable.center).sum(dim=0).argmax())
    away = (usable.center - usable.center[busiest]).norm(dim=-1)
    return usable[away.argsort()[:MOST_CAMERAS]]


def _bed(
    given: Float[Tensor, "n 3"],
    first: Float[Tensor, "n 3"],
    seen: Bool[Tensor, "n m"],
    viewpoints: Viewpoints,
    index_ratio: float,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """The points below the plane z = 0 that an alignment without water shows as those given, and by how much it misses
    them; found from `first` on."""
    point, view = seen.nonzero().unbind(dim=-1)
    bed, missed = first, torch.zeros_like(first)
    for _ in range(ROUNDS):
        bed = bed - missed
        through_water = _scene(bed, Observations(view, point, bed.new_zeros(len(point), 2)), viewpoints, index_ratio)
        pixels, _ = through_water.camera_of(view).project(bed[point])
        straight = _scene(given, Observations(view, point, pixels), viewpoints, 1.0)
        aligned, _ = readjust(straight, Survey.empty(viewpoints.names), WITHOUT_WATER)
        aligned = transformed(aligned, align_similarity(aligned.views.center, viewpoints.center))
        missed = torch.where(aligned.placed[:, None], aligned.points - given, 0.0)
    return bed, missed


def _scene(
    points: Float[Tensor, "n 3"], observations: Observations, viewpoints: Viewpoints, index_ratio: float
) -> Scene:
    assert viewpoints.rotation is not None
    assert viewpoints.field is not None
    return Scene.create(
        Rigid(viewpoints.rotation, viewpoints.center),
        Cameras.of([_lens(field) for field in viewpoints.field.tolist()]),
        Interfaces.level(index_ratio),
        points,
        observations,
        names=viewpoints.names,
        camera=torch.arange(len(viewpoints)),
    )


def _lens(field: list[float]) -> Intrinsics:
    """A pinhole that shows the same."""
    left, right, top, bottom = (FOCAL * edge for edge in field)
    return Intrinsics.create(max(round(right - left), 1), max(round(bottom - top), 1), FOCAL, (-left, -top))


def _rms(vectors: Float[Tensor, "n 3"]) -> float:
    return float(vectors.square().sum(dim=-1).mean().sqrt())
