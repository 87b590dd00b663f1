"""Relative pose of two cameras above water when nobody measured which way is down: the water itself shows it.

With both verticals known the pose follows linearly from the matches (Chang & Chen, ICCV 2011, section 3.4.1). Without
them a pinhole relative pose helps: its rotation R_21 is a few degrees off through water, but takes a vertical of the
first camera to one of the second, so that two of four angles are left to try. Each direction of a grid over the cap of
CAP_DEG about the optical axis gives one linear pose; those with the least refractive epipolar errors are refined in all
eight unknowns (see `TwoViews`, gravity_sigma infinite), and the search is repeated with the rotation and the inliers
that came out, because a pinhole agrees only with a part of the right matches.

How well a vertical is determined follows from the Hessian, and from the other poses that explain the matches as well.
Fails where refraction is weak: the index near 1, or rays near the vertical only, so that any plane does.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.geometry import heading_rotation, level_rotation, rotate
from torchrefrac.minimal import relative_pose_npt
from torchrefrac.minimal.rays import require_matches
from torchrefrac.numerics import thin
from torchrefrac.optim import covariance_of
from torchrefrac.ransac.pose import level_rays, refine_in_stages, tightened
from torchrefrac.refinement import TwoViews, tilt_and_heading
from torchrefrac.sfm.pinhole import essential_pose

CAP_DEG, SPACING_DEG = 75.0, 9.0
ROUNDS = 3
SOLVED, SCORED, JUDGED = 300, 200, 400
LEADERS, FINALISTS = 24, 8
ON_CONSENSUS, ON_ALL, TO_THE_END = ((3.0, 8), (1.0, 8)), ((3.0, 6), (1.0, 6)), ((1.0, 20),)
"""Stages of a refinement: how far max_error is widened, and the iterations."""
AS_GOOD = 8.0
"""How many wrong matches more another pose may have and still count as an explanation."""
CHANCE_FACTOR = 3
MAX_SIGMA_DEG = 5.0
UNKNOWNS = 8
Models = Float[Tensor, "h 8"]

Status = Literal["success", "no_consensus", "degenerate"]


@dataclass(frozen=True)
class UnknownVertical:
    """rotation cam_from_world and center of cameras of which the first stands at (0, 0, 1) with heading 0; down_in_cam,
    and sigma: the expected root-mean-square angle in radians to the true ones. noise: robust standard deviation of an
    epipolar error, pixels.

    A failure has what was found; without a consensus that is nothing and sigma is infinite. `detail` says why.
    """

    status: Status
    rotation: Float[Tensor, "2 3 3"]
    center: Float[Tensor, "2 3"]
    inliers: Bool[Tensor, " n"]
    down_in_cam: Float[Tensor, "2 3"]
    sigma: Float[Tensor, " 2"]
    noise: float = math.inf
    detail: str = ""


def find_verticals(
    plane1: Float[Tensor, "n 2"],
    plane2: Float[Tensor, "n 2"],
    focal: Float[Tensor, "*view 2"],
    index_ratio: Float[Tensor, ""] | float,
    max_error: float = 4.0,
    min_inliers: int = 20,
) -> UnknownVertical:
    """Pose and verticals of two cameras from matches: ideal image coordinates plane1, plane2, focal in pixels, of both
    or of each.

    A match is an inlier within max_error pixels. Deterministic. "no_consensus": fewer agree than min_inliers and
    CHANCE_FACTOR times as many as when the matches are shuffled; "degenerate": sigma above MAX_SIGMA_DEG.
    """
    require_matches(plane1, plane2=plane2)
    require(plane1, "image coordinates")
    require(plane2, "plane2")
    require(index_ratio, "index_ratio", above=1.0)
    require(max_error, "max_error", above=0.0)
    start = pinhole_rotation(plane1, plane2, max_error / float(focal.mean())) if len(plane1) >= min_inliers else None
    if start is None:
        return _nothing(plane1, f"a pinhole relative pose of {len(plane1)} matches does not exist")
    views = TwoViews(
        plane1,
        plane2,
        cam_from_level=level_rotation(plane1.new_tensor((0.0, 0.0, 1.0)).expand(2, 3)),
        focal=focal,
        index_ratio=torch.as_tensor(index_ratio, dtype=plane1.dtype),
        gravity_sigma=math.inf,
    )
    relative, inliers = start
    best, lowest = torch.zeros(0, UNKNOWNS), math.inf
    for _ in range(ROUNDS):
        models, costs = _search(views, relative, inliers, max_error)
        if not len(models) or float(costs[0]) >= (1.0 - 1e-3) * lowest:
            break
        best, lowest = models[costs - costs[0] < AS_GOOD * max_error**2], float(costs[0])
        rotation, _ = views.poses(best[:1])
        relative, inliers = rotation[0, 1] @ rotation[0, 0].mT, _agree(views, best[0], 2.0 * max_error)
    return _report(views, best, max_error, min_inliers)


def pinhole_rotation(
    plane1: Float[Tensor, "n 2"], plane2: Float[Tensor, "n 2"], threshold: float
) -> tuple[Float[Tensor, "3 3"], Bool[Tensor, " n"]] | None:
    """Relative rotation and consensus of OpenCV's essential matrix."""
    found = essential_pose(plane1, plane2, cv2.USAC_DEFAULT, 0.999, threshold)
    return None if found is None else (found[0], found[2])


def _search(
    views: TwoViews, relative: Float[Tensor, "3 3"], inliers: Bool[Tensor, " n"], max_error: float
) -> tuple[Models, Float[Tensor, " h"]]:
    """Refined models and their costs on all matches, best first; none where no vertical gives a pose."""
    rows = inliers.nonzero()[:, 0]
    models = views.plane1.new_zeros(0, UNKNOWNS)
    if len(rows) >= UNKNOWNS:
        models = _hypotheses(views.rows(thin(rows, SOLVED)), relative)
    if not len(models):
        return models, models[:, 0]
    consensus, part = views.rows(thin(rows, SCORED)), views.rows(thin(torch.arange(len(views)), JUDGED))
    models, _ = _best(models, consensus, 3.0 * max_error, LEADERS)
    models = refine_in_stages(consensus, models, max_error, ON_CONSENSUS)
    models = refine_in_stages(part, models, max_error, ON_ALL)
    models, _ = _best(models, part, max_error, FINALISTS)
    models = refine_in_stages(views, models, max_error, TO_THE_END)
    return _best(models, views, max_error, FINALISTS)


def _hypotheses(views: TwoViews, relative: Float[Tensor, "3 3"]) -> Models:
    """Linear poses for every vertical of the grid that is below the horizon of both cameras."""
    down1 = _cap(views.plane1)
    down2 = rotate(relative, down1)
    cam_from_level = level_rotation(torch.stack((down1, down2), dim=1)[down2[:, 2] > 0.0])
    rays = level_rays(torch.stack((views.plane1, views.plane2)), cam_from_level)
    heading, center, valid = relative_pose_npt(rays[:, 0], rays[:, 1], views.index_ratio, views.height)
    first = cam_from_level[:, None, 0].expand(*heading.shape, 3, 3)
    rotation = torch.stack((first, cam_from_level[:, None, 1] @ heading_rotation(heading)), dim=-3)
    tilt, turned = tilt_and_heading(views.cam_from_level, rotation)
    return torch.cat((tilt.flatten(-2), turned[..., 1:], center), dim=-1)[valid]


def _cap(like: Float[Tensor, "..."]) -> Float[Tensor, "k 3"]:
    """Directions within CAP_DEG of the optical axis, SPACING_DEG apart, on a Fibonacci spiral."""
    height, spacing = 1.0 - math.cos(math.radians(CAP_DEG)), math.radians(SPACING_DEG)
    count = math.ceil(2.0 * math.pi * height / spacing**2)
    k = torch.arange(count, dtype=like.dtype, device=like.device) + 0.5
    z, turn = 1.0 - height * k / count, math.pi * (3.0 - math.sqrt(5.0)) * k
    radius = (1.0 - z * z).sqrt()
    return torch.stack((radius * turn.cos(), radius * turn.sin(), z), dim=-1)


def _best(
    models: Models, views: TwoViews, max_error: float, count: int
) -> tuple[Float[Tensor, "best 8"], Float[Tensor, " best"]]:
    costs, order = views.costs(models, max_error).topk(min(count, len(models)), largest=False)
    return models[order], costs


def _agree(views: TwoViews, model: Float[Tensor, " 8"], max_error: float) -> Bool[Tensor, " n"]:
    errors = views.errors(model[None])
    return (errors.possible & (errors.error.abs() < max_error))[0]


def _variance(views: TwoViews, model: Float[Tensor, " 8"], max_error: float) -> float:
    """Variance of an epipolar error, from the inliers, in squared pixels."""
    error = views.errors(model[None]).error[0][_agree(views, model, max_error)]
    return float(error.square().sum()) / max(len(error) - UNKNOWNS, 1)


def _report(views: TwoViews, models: Models, max_error: float, min_inliers: int) -> UnknownVertical:
    """The first of models that explain the matches equally well. They are refined once more at a threshold that follows
    from the noise."""
    if not len(models):
        return _nothing(views.plane1, "no vertical gives a pose that places the second camera above the water")
    tight = float(tightened(views.squared_errors(models[:1]), max_error))
    models = refine_in_stages(views, models, tight, TO_THE_END)
    inliers, shuffled = (
        _agree(v, models[0], max_error) for v in (views, replace(views, plane2=views.plane2.roll(len(views) // 2, 0)))
    )
    needed = min_inliers + CHANCE_FACTOR * int(shuffled.sum())
    count = int(inliers.sum())
    if count < needed:
        return _nothing(views.plane1, f"only {count} of {len(views)} matches agree on a pose, but {needed} must")
    rotations, centers = views.poses(models)
    down = -rotations[..., 2]
    sigma = _sigma(views, models[0], down[0], tight)
    others = torch.atan2(torch.linalg.cross(down, down[:1].expand_as(down)).norm(dim=-1), (down * down[0]).sum(dim=-1))
    sigma = torch.maximum(sigma, others.amax(dim=0))
    noise = float(tightened(views.squared_errors(models[:1]), max_error)) / 3.0
    found = UnknownVertical("success", rotations[0], centers[0], inliers, down[0], sigma, noise)
    if (degrees := math.degrees(float(sigma.amax()))) <= MAX_SIGMA_DEG:
        return found
    detail = f"the vertical is determined to {degrees:.1f} degrees only: refraction is too weak to show the water"
    return replace(found, status="degenerate", detail=detail)


def _sigma(
    views: TwoViews, model: Float[Tensor, " 8"], down: Float[Tensor, "2 3"], max_error: float
) -> Float[Tensor, " 2"]:
    """Root-mean-square angle of both verticals, where the tilts are measured from themselves."""
    rotation, _ = views.poses(model[None])
    views = replace(views, cam_from_level=level_rotation(down))
    tilt, heading = tilt_and_heading(views.cam_from_level, rotation[0])
    upright = torch.cat((tilt.flatten(), heading[1:], model[5:]))
    hessian = views.refine(upright[None], max_error, 0).quadratic.hessian[0]
    covariance, exists = covariance_of(hessian[None])
    variance = covariance[0].diagonal()[:4] * _variance(views, upright, max_error)
    return torch.where(exists, variance.unflatten(0, (2, 2)).sum(dim=-1).sqrt(), torch.inf)


def _nothing(plane: Float[Tensor, "n 2"], detail: str) -> UnknownVertical:
    vectors, infinite = plane.new_zeros(2, 3), plane.new_full((2,), torch.inf)
    nobody = torch.zeros(len(plane), dtype=torch.bool)
    return UnknownVertical("no_consensus", plane.new_zeros(2, 3, 3), vectors, nobody, vectors, infinite, detail=detail)
