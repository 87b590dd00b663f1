"""How far a dense reconstruction lies from the true surfaces, and how much of them it covers. Units are in the keys."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.evaluate.metrics import over_sigma, rms
from torchrefrac.evaluate.true_surface import TrueSurface, distance_to_each_rectangle
from torchrefrac.geometry import Similarity
from torchrefrac.scene.dense import DenseCloud
from torchrefrac.scene.truth import Truth

WITHIN = (0.1, 0.2, 0.5)
TYPICAL, FOUND = WITHIN[1:]  # where there is room for one: of accuracy, of completeness
MAD_TO_SIGMA = 1.4826  # the standard deviation of a normal distribution over its median absolute deviation
INLIER_SIGMAS = 3.0
LEAST_TOLD = 0.05  # per cent of the points
Metrics = dict[str, float | int | list[float | None]]


def evaluate_dense_run(
    cloud: DenseCloud, truth: Truth | None, alignment: Similarity | None, seen: Float[Tensor, "k 3"] | None
) -> Metrics:
    """How many points there are, their median views, score and sigmas; where the truth is known what `evaluate_dense`
    says, too."""
    metrics: Metrics = {"dense_points": len(cloud)}
    if len(cloud):
        metrics |= {
            "dense_views_median": float(cloud.views.double().median()),
            "dense_score_median": float(cloud.score.median()),
            f"dense_sigma_median_{cloud.length_unit}": float(cloud.sigma.median()),
            f"dense_relative_sigma_median_{cloud.length_unit}": float(cloud.relative_sigma.median()),
        }
    return metrics if truth is None or alignment is None else metrics | evaluate_dense(cloud, truth, alignment, seen)


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
    - dense_error_over_sigma: RMS, over all points, of that distance over the point's sigma, about 1 where sigma is
      honest; sigma is along the axis that is known worst, so that less says nothing against it;
    - dense_plane_rms_UNIT: RMS distance to the nearest true plane over the inliers, those within 3 robust standard
      deviations (1.4826 times the median error) of this cloud's own errors; dense_plane_inliers, their share;
      dense_plane_rms_each_UNIT, the same for each plane (None where no inlier lies nearest to it); beside a mesh, only
      points take part whose nearest place of the surface lies on a plane.

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
        metrics |= over_sigma("dense", distance, alignment.scale * cloud.sigma)
        flat = surface.nearest_is_plane(points, distance)
        if flat.any():
            metrics |= _plane_metrics(points[flat], truth)
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
    normal = torch.where(truth.normal[:, 2:] < 0.0, -truth.normal, truth.normal)
    return ((points - truth.corner[nearest]) * normal[nearest]).sum(dim=-1), nearest


def without_outliers(metrics: Mapping[str, Any]) -> str:
    """How to go on after the RMS distance from the planes: which share of the points it leaves out; empty for none.

    What is left out is far off for this cloud, and that little or nothing is says nothing for a model that is wrong.
    """
    share = 100.0 * (1.0 - metrics["dense_plane_inliers"])
    return f" without the farthest {share:.1f} %" if share >= LEAST_TOLD else ""


def _plane_metrics(points: Float[Tensor, "n 3"], truth: Truth) -> Metrics:
    """Of points in the truth's frame."""
    signed, plane = signed_plane_distance(points, truth)
    size = signed.abs()
    inlier = size <= INLIER_SIGMAS * MAD_TO_SIGMA * _quantile(size, 0.5)
    each = [signed[inlier & (plane == index)] for index in range(len(truth.corner))]
    return {
        f"dense_plane_rms_{truth.length_unit}": rms(signed[inlier]),
        f"dense_plane_rms_each_{truth.length_unit}": [rms(values) if len(values) else None for values in each],
        "dense_plane_inliers": float(inlier.double().mean()),
    }


def _distance_to_nearest(
    queries: Float[Tensor, "k 3"], points: Float[Tensor, "n 3"], reach: float
) -> Float[Tensor, " k"]:
    """Distance of queries to the nearest of points; infinite beyond `reach`."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    tree = KDTree(points.cpu().numpy(), balanced_tree=False, compact_nodes=False)
    gap, _ = tree.query(queries.cpu().numpy(), distance_upper_bound=reach, workers=1)
    return torch.from_numpy(np.asarray(gap))


def _quantile(values: Float[Tensor, " n"], share: float) -> float:
    """`Tensor.quantile` refuses more than 16 million values."""
    return float(np.quantile(values.cpu().numpy(), share))
