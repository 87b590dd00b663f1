"""Whether the matches that agree on a pose determine it, judged from the information that they carry.

The covariance of the pose follows from its quadratic model, pixels of `pixel_sigma` and gravity as a prior. Where it is
as large as the pose itself, any pose of a whole family explains the matches, and none is given. Both degenerate cases
of Chang & Chen (ICCV 2011, section 3.4.1) and refraction that is too weak show themselves in this way.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.optim import covariance_of
from torchrefrac.refinement import OneView, PoseData, TwoViews

MAX_UNCERTAINTY = 0.3
NARROW = 0.02


def explain_relative(inliers: TwoViews, models: Float[Tensor, "k 8"]) -> list[str]:
    """Why matches, of one pair or of each model's own, do not determine the relative poses; empty if they do."""
    _, centers = inliers.poses(models)
    much = _uncertainties(inliers, models, (centers[:, 1] - centers[:, 0]).norm(dim=-1), "the baseline")
    return [
        words and f"the position of the second camera is uncertain {words}: {_reason(inliers, models, i)}"
        for i, words in enumerate(much)
    ]


def explain_absolute(inliers: OneView, models: Float[Tensor, "k 6"]) -> list[str]:
    """Why points, of one view or of each model's own, do not determine the poses; empty if they do."""
    why = "the points lie too close together or on one vertical line"
    much = _uncertainties(inliers, models, models[:, 5], "the camera's height")
    return [words and f"the position of the camera is uncertain {words}: {why}" for words in much]


def _uncertainties(
    data: PoseData[Any], models: Float[Tensor, "k d"], length: Float[Tensor, " k"], of: str
) -> list[str]:
    """How uncertain the last three unknowns, a position, are where that is too much against a length; else empty."""
    covariance, exists = covariance_of(data.linearize(models, math.inf).hessian)
    sigma = data.pixel_sigma * covariance.diagonal(dim1=-2, dim2=-1)[:, -3:].sum(dim=-1).sqrt()
    uncertainty = torch.where(exists, sigma / length, torch.inf).tolist()
    return ["" if much <= MAX_UNCERTAINTY else _in_words(much, of) for much in uncertainty]


def _in_words(uncertainty: float, of: str) -> str:
    return "by any amount" if math.isinf(uncertainty) else f"to {100.0 * uncertainty:.0f} % of {of}"


def _reason(views: TwoViews, models: Float[Tensor, "k 8"], which: int) -> str:
    """Which of the known cases it looks like."""
    views, models = views.of_models(torch.tensor([which], device=models.device)), models[which, None]
    points, centers = views.points(models)[0][:, :2], views.poses(models)[1][0]
    points = points if views.exists is None else points[views.exists[0]]
    middle, along = centers[:, :2].mean(dim=0), centers[1, :2] - centers[0, :2]
    along = along / along.norm()
    offset = points - middle
    side = (offset[:, 0] * along[1] - offset[:, 1] * along[0]).square().mean().sqrt()
    ahead = (offset @ along).square().mean().sqrt()
    reach = NARROW * max(float(side), float(ahead))
    level = abs(float(centers[1, 2] - centers[0, 2])) < NARROW * float(centers[:, 2].mean())
    if float(side) < reach:
        return "all points lie in the vertical plane through both cameras"
    if level and float(ahead) < reach:
        return "both cameras are equally high and all points lie in the plane that bisects their baseline"
    return (
        f"at an index ratio of {float(views.index_ratio):.6g} the water bends these rays too little to show where its "
        "surface is"
    )
