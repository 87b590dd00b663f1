"""Errors of sparse points against what their own pixels truly see, and how bent they lie. Units are in the keys."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.evaluate.true_surface import TrueSurface
from torchrefrac.geometry import Similarity
from torchrefrac.numerics import segment_sum
from torchrefrac.scene import Scene

WORST = 20  # one in so many, the worst, takes no part in an RMS
MIN_POINTS = 10  # of a plane whose flatness counts


class TruePlaces(NamedTuple):
    """Where the points of a scene truly are; the index of the true plane that more than half of their observations see,
    -1 where there is none; and whether any is known."""

    points: Float[Tensor, "n 3"]
    plane: Int[Tensor, " n"]
    known: Bool[Tensor, " n"]


def point_metrics(scene: Scene, surface: TrueSurface, alignment: Similarity) -> dict[str, float]:
    """Figures of points after `alignment`, which maps their frame to that of the truth; see `true_places`.

    With UNIT the truth's length unit:

    - point_median_UNIT, point_rms_UNIT: of the distance between a point and its true place, in 3D; the RMS leaves out
      the 5 % with the largest;
    - flatness_UNIT: how far points depart from their shape, wherever they are: see `flatness`.

    What is not defined is left out: without a true surface, index ratio and intrinsics, or points whose place is known.
    """
    places = true_places(scene, surface)
    if places is None or not bool(places.known.any()):
        return {}
    points, unit = alignment.apply(scene.points), surface.truth.length_unit
    error = (points - places.points).norm(dim=-1)[places.known]
    metrics = {
        f"point_median_{unit}": float(error.median()),
        f"point_rms_{unit}": float(error[_all_but_the_worst(error)].square().mean().sqrt()),
    }
    bend = flatness(points, places, len(surface.truth.corner))
    return metrics if bend is None else metrics | {f"flatness_{unit}": bend}


def true_places(scene: Scene, surface: TrueSurface) -> TruePlaces | None:
    """Where the points of a finished scene truly are; None where the truth does not say.

    The pixel of each observation is cast through the true camera (pose, intrinsics, water) onto the true surface. The
    true place of a point is the median, component by component, over its observations in registered images: a wrong
    match in one of three and more does not move it, and where there are only two, the point's error shows it. No
    nearness takes part: this holds for scenes that are bent by whatever amount. A point none of whose observations
    meets the surface has no place. None without a true index ratio or intrinsics, or for photographs of another size.
    """
    truth, intrinsics, views = surface.truth, surface.truth.intrinsics, scene.views
    if intrinsics is None or truth.interfaces is None or not surface.is_known:
        return None
    number = {name: i for i, name in enumerate(truth.names)}
    theirs = torch.tensor([number.get(name, -1) for name in views.names], dtype=torch.long)
    if not _same_sizes(scene, intrinsics, theirs):
        return None
    theirs = torch.where(views.registered, theirs, -1)[scene.observations.view]
    observed = scene.observations[theirs >= 0]
    theirs, point, count = theirs[theirs >= 0], observed.point, len(scene.points)
    true_pose = truth.rotation[theirs], truth.center[theirs]
    own = intrinsics.indexed(theirs, (len(truth.names),))
    cameras = RefractiveCamera(own, *true_pose, truth.interfaces.of_views(torch.zeros_like(theirs)), check=False)
    seen = surface.cast(cameras, observed.pixels)
    point = point[seen.valid]
    views = torch.bincount(point, minlength=count)
    on_plane = seen.plane[seen.valid, None] == torch.arange(max(len(truth.corner), 1))
    votes, plane = segment_sum(on_plane.long(), point, count).max(dim=-1)
    return TruePlaces(
        points=segment_median(seen.points[seen.valid], point, count),
        plane=torch.where(2 * votes > views, plane, -1),
        known=views > 0,
    )


def _same_sizes(scene: Scene, intrinsics: Intrinsics, theirs: Int[Tensor, " m"]) -> bool:
    """Whether the photographs of a scene have the sizes of the true ones, whose numbers are `theirs` (-1: of none)."""
    ours = torch.tensor(scene.cameras.sizes)[scene.views.camera]
    if intrinsics.sizes is None:
        return bool((ours == torch.tensor((intrinsics.width, intrinsics.height))).all())
    return bool((ours == intrinsics.sizes[theirs])[theirs >= 0].all())


def flatness(points: Float[Tensor, "n 3"], places: TruePlaces, planes: int) -> float | None:
    """RMS departure of points, in the frame and the scale of the truth, from the shape they truly have.

    With `planes` true ones: for each with at least 10 points whose true place lies on it, a plane is fitted to the
    points by total least squares, the 5 % that are farthest from it are left out, and a plane is fitted to the others;
    their distances from it count. Which plane a point belongs to comes from its pixels, never from where it is. None
    where no plane has enough points.

    Without planes (a riverbed): the error in height, less the best affine function of the true x and y, with the same
    points left out, over all points whose place is known. Of points on a level plane both are the same to the first
    order: a shift and a tilt do not count, a bend does.
    """
    if planes:
        groups = [points[places.known & (places.plane == index)] for index in range(planes)]
        distances = [_distances(group, _plane_distance) for group in groups if len(group) >= MIN_POINTS]
    else:
        ours, true = points[places.known], places.points[places.known]
        rows = torch.cat((true[:, :2], (ours - true)[:, 2:]), dim=-1)
        distances = [_distances(rows, _affine_distance)] if len(rows) >= MIN_POINTS else []
    return float(torch.cat(distances).square().mean().sqrt()) if distances else None


def segment_median(
    values: Float[Tensor, "n k"], segment: Int[Tensor, " n"], num_segments: int
) -> Float[Tensor, "{num_segments} k"]:
    """Median, column by column, of the rows of values that carry the same id in `segment`; the mean of the middle two
    where they are even in number, zero where there are none."""
    count = torch.bincount(segment, minlength=num_segments)
    first = count.cumsum(0) - count
    has = count > 0
    median = values.new_zeros(num_segments, values.shape[1])
    for column in range(values.shape[1]):
        order = values[:, column].argsort()
        order = order[segment[order].argsort(stable=True)]
        ordered = values[order, column]
        low, high = ordered[(first + (count - 1) // 2)[has]], ordered[(first + count // 2)[has]]
        median[has, column] = 0.5 * (low + high)
    return median


def _distances(
    rows: Float[Tensor, "n 3"], distance_to_fit: Callable[[Float[Tensor, "n 3"]], Float[Tensor, " n"]]
) -> Float[Tensor, " m"]:
    """To what is fitted to all but the worst, of these."""
    near = _all_but_the_worst(distance_to_fit(rows).abs())
    return distance_to_fit(rows[near])


def _all_but_the_worst(errors: Float[Tensor, " n"]) -> Int[Tensor, " m"]:
    """Rows of `errors` without the largest of each twenty."""
    return errors.argsort()[: len(errors) - len(errors) // WORST]


def _plane_distance(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Signed distances of points to the plane that fits them best by total least squares."""
    offset = points - points.mean(dim=0)
    return offset @ torch.linalg.eigh(offset.mT @ offset).eigenvectors[:, 0]


def _affine_distance(rows: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Of rows of x, y and an error: the error less its best affine function of x and y."""
    offset = rows - rows.mean(dim=0)
    plan, error = offset[:, :2], offset[:, 2]
    return error - plan @ torch.linalg.lstsq(plan, error[:, None], driver="gelsd").solution[:, 0]
