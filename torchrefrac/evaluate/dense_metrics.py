"""How far a dense reconstruction lies from the true surfaces, and how much of them it covers. Units are in the keys."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.evaluate.metrics import rms
from torchrefrac.evaluate.true_surface import TrueSurface, distance_to_each_rectangle
from torchrefrac.geometry import Similarity
from torchrefrac.scene.dense import DenseCloud
from torchrefrac.scene.truth import Truth, TruthPoints

WITHIN = (0.1, 0.2, 0.5)
TYPICAL, FOUND = WITHIN[1:]  # where there is room for one: of accuracy, of completeness
MAD_TO_SIGMA = 1.4826  # the standard deviation of a normal distribution over its median absolute deviation
INLIER_SIGMAS = 3.0
SAME_PLACE = 1.5  # times the distance between neighbouring entries: two images' entries of one place are nearer
Metrics = dict[str, float | int | list[float | None]]


def summarize_dense(cloud: DenseCloud) -> Metrics:
    """What can be said without truth: how many points there are, and their median views, score and sigma."""
    metrics: Metrics = {"dense_points": len(cloud)}
    if len(cloud):
        metrics |= {
            "dense_views_median": float(cloud.views.double().median()),
            "dense_score_median": float(cloud.score.median()),
            f"dense_sigma_median_{cloud.length_unit}": float(cloud.sigma.median()),
        }
    return metrics


def evaluate_dense(
    cloud: DenseCloud,
    truth: Truth,
    alignment: Similarity,
    seen: Float[Tensor, "k 3"] | None,
    within: Sequence[float] = WITHIN,
) -> Metrics:
    """Errors of a dense cloud after `alignment`, which maps its frame to that of the truth.

    With UNIT the truth's length unit, for every threshold T of `within`:

    - dense_accuracy_within_T_UNIT: share (0 to 1) of the points that lie nearer than T to the true surface: the mesh of
      the truth, or its rectangles where it has none;
    - dense_completeness_within_T_UNIT: share of `seen`, true surface points in the truth's frame that should be
      there (see `textured_points`), with a point of the cloud nearer than T;
    - dense_surface_median_UNIT, dense_surface_p95_UNIT: of the distance to the nearest place of it;
    - dense_plane_rms_UNIT: RMS distance to the nearest true plane over the inliers, those within 3 robust standard
      deviations (1.4826 times the median error) of this cloud's own errors; dense_plane_inliers, their share;
      dense_plane_rms_each_UNIT, the same for each plane (None where no inlier lies nearest to it); beside a mesh, only
      points take part whose nearest place of the surface lies on a plane;
    - dense_error_over_sigma: RMS over the inliers of that distance over the point's sigma, about 1 where sigma is
      honest and surfaces are seen from straight above; sigma is along the viewing ray, so a slanted view makes it less.

    What is not defined is left out: accuracy without points or a true surface, what is of
    planes without any, completeness without `seen`.
    """
    unit, points = truth.length_unit, alignment.apply(cloud.points)
    metrics: Metrics = {}
    surface = TrueSurface(truth)
    if len(points) and surface.is_known:
        distance = surface.distance(points)
        metrics |= {f"dense_accuracy_within_{t:g}_{unit}": float((distance < t).double().mean()) for t in within}
        metrics[f"dense_surface_median_{unit}"] = _quantile(distance, 0.5)
        metrics[f"dense_surface_p95_{unit}"] = _quantile(distance, 0.95)
        flat = surface.nearest_is_plane(points, distance)
        if flat.any():
            metrics |= _plane_metrics(points[flat], alignment.scale * cloud.sigma[flat], truth)
    if seen is not None and len(seen):
        gap = _distance_to_nearest(seen, points, max(within))
        metrics |= {f"dense_completeness_within_{t:g}_{unit}": float((gap < t).double().mean()) for t in within}
    return metrics


def signed_plane_distance(points: Float[Tensor, "n 3"], truth: Truth) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Distance of points to the plane of the nearest true rectangle, and that rectangle's index.

    Positive above the plane, on the side of its normal that points up (of a vertical plane, of its normal as it is).
    The plane goes on beyond its rectangle here: an error along a surface does not count, as it is none across it.
    """
    if not len(truth.corner):
        raise ValueError("truth has no planes, but a distance to one needs at least one")
    nearest = distance_to_each_rectangle(points, truth).argmin(dim=-1)
    normal = truth.normal
    normal = torch.where(normal[:, 2:] < 0.0, -normal, normal)
    return ((points - truth.corner[nearest]) * normal[nearest]).sum(dim=-1), nearest


def textured_points(
    truth_points: TruthPoints,
    images: Sequence[Shaped[Tensor, "height width"]],
    min_views: int = 3,
    min_contrast: float = 2.0,
    window: int = 11,
) -> Float[Tensor, "k 3"]:
    """True points that a reconstruction should contain: seen by `min_views` images and textured.

    images: grey values from 0 to 255, one for each name of `truth_points`. A point is textured where the grey
    values of the window x window pixels around its pixel, in the image it belongs to, have a standard deviation of at
    least min_contrast. Another image sees it too where one of that image's own true points lies within 1.5 times the
    distance between neighbouring ones there: this asks no camera model. A place may come from several images.
    Raises ValueError where the images are not those of the points, or `window` is even.
    """
    if len(images) != len(truth_points.names):
        raise ValueError(f"images are {len(images)}, but truth_points is of {len(truth_points.names)} images")
    if window < 1 or window % 2 == 0:
        raise ValueError(f"window is {window}, but must be odd, so that it has a middle")
    if not images:
        return torch.zeros(0, 3, dtype=torch.float64)
    contrast = torch.stack([_contrast(image, truth_points.pixels(), window) for image in images])
    textured = truth_points.valid & (contrast >= min_contrast)
    points = [table[chosen].numpy() for table, chosen in zip(truth_points.points, textured, strict=True)]
    views = _count_views(points, truth_points, min_views)
    return torch.from_numpy(np.concatenate([p[v >= min_views] for p, v in zip(points, views, strict=True)]))


def _plane_metrics(points: Float[Tensor, "n 3"], sigma: Float[Tensor, " n"], truth: Truth) -> Metrics:
    """Of points in the truth's frame, with their standard deviations."""
    signed, plane = signed_plane_distance(points, truth)
    size = signed.abs()
    inlier = size <= INLIER_SIGMAS * MAD_TO_SIGMA * _quantile(size, 0.5)
    each = [signed[inlier & (plane == index)] for index in range(len(truth.corner))]
    metrics: Metrics = {
        f"dense_plane_rms_{truth.length_unit}": rms(signed[inlier]),
        f"dense_plane_rms_each_{truth.length_unit}": [rms(values) if len(values) else None for values in each],
        "dense_plane_inliers": float(inlier.double().mean()),
    }
    known = inlier & (sigma > 0.0)
    if known.any():
        metrics["dense_error_over_sigma"] = rms(signed[known] / sigma[known])
    return metrics


def _distance_to_nearest(
    queries: Float[Tensor, "k 3"], points: Float[Tensor, "n 3"], reach: float
) -> Float[Tensor, " k"]:
    """Distance of queries to the nearest of points; infinite beyond `reach`."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    tree = KDTree(points.cpu().numpy(), balanced_tree=False, compact_nodes=False)
    gap, _ = tree.query(queries.cpu().numpy(), distance_upper_bound=reach, workers=1)
    return torch.from_numpy(np.asarray(gap))


def _contrast(
    image: Shaped[Tensor, "height width"], pixels: Float[Tensor, "h w 2"], window: int
) -> Float[Tensor, "h w"]:
    """Standard deviation of an image in the window around each of the pixels, cut at the border."""
    column, row = pixels.floor().long().unbind(dim=-1)
    height, width = image.shape
    if pixels.min() < 0 or column.max() >= width or row.max() >= height:
        wants = f"{int(column.max()) + 1} x {int(row.max()) + 1}"
        raise ValueError(f"image is {width} x {height} pixels, but the true points need at least {wants}")
    grey = image.double()
    grey = grey - grey.mean()
    mean, square = _window_mean(grey, window)[row, column], _window_mean(grey.square(), window)[row, column]
    return (square - mean.square()).clamp(min=0.0).sqrt()


def _window_mean(image: Float[Tensor, "h w"], window: int) -> Float[Tensor, "h w"]:
    """Mean over the pixels of the image that lie in the window around each."""
    for kernel in ((window, 1), (1, window)):
        padding = (kernel[0] // 2, kernel[1] // 2)
        image = torch.nn.functional.avg_pool2d(image[None], kernel, 1, padding, count_include_pad=False)[0]
    return image


def _count_views(
    points: Sequence[Float[np.ndarray, "_ 3"]], truth_points: TruthPoints, enough: int
) -> list[Int[np.ndarray, " _"]]:
    """By how many images each of the points of image i is seen; counted no further than to `enough`."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    entries = [table[valid].numpy() for table, valid in zip(truth_points.points, truth_points.valid, strict=True)]
    trees = [KDTree(table, balanced_tree=False, compact_nodes=False) for table in entries]
    reach = [
        np.append(SAME_PLACE * _spacing(table, valid)[valid].numpy(), 0.0)  # the last is that of a query without answer
        for table, valid in zip(truth_points.points, truth_points.valid, strict=True)
    ]
    views = [np.ones(len(own), dtype=np.int64) for own in points]
    count = len(points)
    for shift in sorted(range(1, count), key=lambda shift: min(shift, count - shift)):  # images nearby see most
        for image in range(count):
            other = (image + shift) % count
            rows = np.flatnonzero(views[image] < enough)
            gap, nearest = trees[other].query(points[image][rows], distance_upper_bound=reach[other].max(), workers=1)
            views[image][rows] += gap < reach[other][nearest]
    return views


def _spacing(points: Float[Tensor, "h w 3"], valid: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Distance between neighbouring points of a grid; 0 where a point has no neighbour.

    The longer of two: that to the nearer neighbour in the row, and that to the nearer one in the column.
    """
    in_row = _to_nearer_neighbour(points, valid)
    in_column = _to_nearer_neighbour(points.transpose(0, 1), valid.T).T
    return torch.maximum(*(torch.where(gap.isfinite(), gap, 0.0) for gap in (in_row, in_column)))


def _to_nearer_neighbour(points: Float[Tensor, "h w 3"], valid: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Distance of points to the nearer of their two neighbours in the row; infinite without one."""
    gap = (points[:, 1:] - points[:, :-1]).norm(dim=-1)
    gap = torch.where(valid[:, 1:] & valid[:, :-1], gap, torch.inf)
    padded = torch.nn.functional.pad(gap, (1, 1), value=torch.inf)
    return torch.minimum(padded[:, 1:], padded[:, :-1])


def _quantile(values: Float[Tensor, " n"], share: float) -> float:
    """`Tensor.quantile` refuses more than 16 million values."""
    return float(np.quantile(values.cpu().numpy(), share))
