"""Whether the matches that agree on a pose determine it, judged from the information that they carry.

The covariance of the pose follows from its quadratic model, pixels of `pixel_sigma` and gravity as a prior. Where it is
as large as the pose itself, any pose of a whole family explains the matches, and none is given. Both degenerate cases
of Chang & Chen (ICCV 2011, section 3.4.1) and refraction that is too weak show themselves in this way.
"""

import math

from jaxtyping import Float
from torch import Tensor

from torchrefrac.optim import covariance_of
from torchrefrac.refinement import OneView, TwoViews

MAX_UNCERTAINTY = 0.3
NARROW = 0.02


def explain_relative(views: TwoViews, model: Float[Tensor, " 8"]) -> str:
    """Why inlier matches do not determine the relative pose `model`; empty if they do."""
    hessian = views.linearize(model[None], math.inf).hessian[0]
    _, centers = views.poses(model[None])
    much = _uncertainty(hessian, views.pixel_sigma, float((centers[0, 1] - centers[0, 0]).norm()), "the baseline")
    return much and f"the position of the second camera is uncertain {much}: {_reason(views, model, centers[0])}"


def explain_absolute(view: OneView, model: Float[Tensor, " 6"]) -> str:
    """Why inlier points do not determine the pose `model`; empty if they do."""
    hessian = view.linearize(model[None], math.inf).hessian[0]
    much = _uncertainty(hessian, view.pixel_sigma, float(model[5]), "the camera's height")
    why = "the points lie too close together or on one vertical line"
    return much and f"the position of the camera is uncertain {much}: {why}"


def _uncertainty(hessian: Float[Tensor, "d d"], pixel_sigma: float, length: float, of: str) -> str:
    """How uncertain the last three unknowns, a position, are where that is too much against a length; else empty."""
    covariance, exists = covariance_of(hessian[None])
    sigma = pixel_sigma * math.sqrt(float(covariance[0].diagonal()[-3:].sum())) if bool(exists) else math.inf
    if (uncertainty := sigma / length) <= MAX_UNCERTAINTY:
        return ""
    return "by any amount" if math.isinf(uncertainty) else f"to {100.0 * uncertainty:.0f} % of {of}"


def _reason(views: TwoViews, model: Float[Tensor, " 8"], centers: Float[Tensor, "2 3"]) -> str:
    """Which of the known cases it looks like."""
    points = views.points(model[None])[0][:, :2]
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
