"""Relative and absolute poses of cameras above water with measured verticals, as `ransac` wants them estimated.

Models are refined in stages, from a wide limit of the errors to a narrow one.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.minimal.absolute_pose import unchecked_absolute_pose_2pt
from torchrefrac.minimal.four_point import unchecked_relative_pose_4pt
from torchrefrac.minimal.known_heading import unchecked_absolute_pose_known_heading, unchecked_relative_pose_3pt
from torchrefrac.optim.batched import where_each
from torchrefrac.ransac.coherence import are_coherent
from torchrefrac.ransac.degeneracy import explain_absolute, explain_relative
from torchrefrac.refinement import OneView, PoseData, TwoViews

LAST_ITERATIONS = 6
LEAST_LIMIT = 0.05
LEAST_SHARE = 0.99  # of the inliers of its start, below which a refinement has left their consensus
TILT_PX = 20.0
"""Measured: samples without outliers that it takes for a good enough one are near one while the vertical is good to 10
pixels, and grow with its squared error from there."""

Stages = Sequence[tuple[float, int]]
"""How far max_error is widened, and the iterations."""

D = TypeVar("D", bound=PoseData[Any])


class _Judged(NamedTuple):
    """Models, and the errors of the data under them."""

    models: Float[Tensor, "k d"]
    errors: Any  # `Errors`, a named tuple

    @classmethod
    def of(cls, data: PoseData[Any], models: Float[Tensor, "k d"]) -> "_Judged":
        return cls(models, data.errors(models))

    def unless_fewer_agree(self, refined: "_Judged", max_error: float) -> "_Judged":
        """What models were refined to, but those whose refinement has walked off their consensus as they were."""
        before, after = ((of.errors.squared < max_error * max_error).sum(dim=-1) for of in (self, refined))
        fewer = after < LEAST_SHARE * before
        models = torch.where(fewer[:, None], self.models, refined.models)
        return _Judged(models, where_each(fewer, self.errors, refined.errors))


class PoseEstimator(ABC, Generic[D]):
    """Models are the rows of `data`, whose priors and errors they are refined and judged by; see `msac.Estimator`.

    quick, thorough: the stages of both depths of the optimisation; a thorough one ends with the limit of the noise.
    """

    quick: Stages
    thorough: Stages

    def __init__(self, data: D) -> None:
        self.data = data
        tilt = float(data.gravity_sigma) * float(data.focal.mean())
        self.samples_per_hit = 1.0 + (tilt / TILT_PX) ** 2

    @property
    @abstractmethod
    def sample_size(self) -> int: ...

    @property
    @abstractmethod
    def is_promising(self) -> bool: ...

    @abstractmethod
    def solve(self, samples: Int[Tensor, "s size"]) -> tuple[Float[Tensor, "s m d"], Bool[Tensor, "s m"]]: ...

    @staticmethod
    @abstractmethod
    def explain(inliers: D, models: Float[Tensor, "k d"]) -> list[str]:
        """Why inliers, of the problem or of each model's own, do not determine models; empty if they do."""

    @property
    def num_data(self) -> int:
        return len(self.data)

    @property
    def device(self) -> torch.device:
        return self.data.focal.device

    def squared_errors(self, models: Float[Tensor, "k d"], rows: Int[Tensor, " n"] | None) -> Float[Tensor, "k n"]:
        data = self._single if models.dtype == torch.float32 else self.data
        return (data if rows is None else data.rows(rows)).squared_errors(models)

    def optimize(
        self, models: Float[Tensor, "k d"], max_error: float, rows: Int[Tensor, " n"] | None, thorough: bool
    ) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]:
        data = self.data if rows is None else self.data.rows(rows)
        return optimized(data, models, max_error, self.thorough if thorough else self.quick, thorough)

    def degeneracy(self, model: Float[Tensor, " d"], inliers: Bool[Tensor, " n"]) -> str:
        return self.explain(self.data.rows(inliers), model[None])[0]

    @cached_property
    def _single(self) -> D:
        return self.data.single()

    def _headings(self, count: int) -> Float[Tensor, " {count}"] | None:
        """Of so many samples, where it is known."""
        known = self.data.known_heading
        return None if known is None else self.data.focal.new_full((count,), float(known))


class RelativePoseEstimator(PoseEstimator[TwoViews]):
    """Models are those of `TwoViews`: tilts of both cameras (4), heading and centre of the second, relative to the
    first at (0, 0, height) with heading 0.

    Samples are solved with the measured verticals; the optimisation takes in their errors. The error of a match is the
    smallest correction of both pixels that makes their rays meet, to first order; they must meet below the water.
    """

    quick, thorough = ((2.0, 3), (1.0, 3)), ((1.0, 40),)
    explain = staticmethod(explain_relative)

    def __init__(self, views: TwoViews) -> None:
        require(views.plane1, "image coordinates")
        require(views.plane2, "plane2")
        name = "index_ratio (without refraction neither the scale nor the surface shows)"
        require(views.index_ratio, name, above=1.0)
        super().__init__(views)

    @property
    def sample_size(self) -> int:
        return 4 if self.data.known_heading is None else 3

    @property
    def is_promising(self) -> bool:
        """Whether neighbours in one image are neighbours in the other more often than in wrong matches."""
        return self._is_coherent

    @cached_property
    def _is_coherent(self) -> bool:
        return are_coherent(self.data.plane1, self.data.plane2)

    def solve(self, samples: Int[Tensor, "s size"]) -> tuple[Float[Tensor, "s m 8"], Bool[Tensor, "s m"]]:
        one, two = self._rays
        return relative_models(one[samples], two[samples], self._headings(len(samples)), self.data)

    @cached_property
    def _rays(self) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        views = self.data
        return level_rays(views.plane1, views.cam_from_level[0]), level_rays(views.plane2, views.cam_from_level[1])


class AbsolutePoseEstimator(PoseEstimator[OneView]):
    """Models are those of `OneView`: tilt (2), heading and centre of a camera that sees known points, wet or dry.

    Samples are solved with the measured vertical; the optimisation takes in its error.
    """

    quick, thorough = ((2.0, 3),), ((1.0, 12),)
    explain = staticmethod(explain_absolute)

    def __init__(self, view: OneView) -> None:
        require(view.plane, "image coordinates")
        require(view.points, "points")
        super().__init__(view)

    @property
    def sample_size(self) -> int:
        return 2

    @property
    def is_promising(self) -> bool:
        """Always: what is asked about sees points that exist."""
        return True

    def solve(self, samples: Int[Tensor, "s 2"]) -> tuple[Float[Tensor, "s m 6"], Bool[Tensor, "s m"]]:
        rays, points = self._rays[samples], self.data.points[samples]
        return absolute_models(rays, points, self._headings(len(samples)), self.data)

    @cached_property
    def _rays(self) -> Float[Tensor, "n 3"]:
        return level_rays(self.data.plane, self.data.cam_from_level)


def relative_models(
    rays1: Float[Tensor, "s size 3"],
    rays2: Float[Tensor, "s size 3"],
    heading: Float[Tensor, " s"] | None,
    about: TwoViews,
) -> tuple[Float[Tensor, "s m 8"], Bool[Tensor, "s m"]]:
    """Models of minimal samples of level rays, without tilts, and which are valid; heading: of each, where it is known.
    about: has the index ratio and the height of the first camera."""
    if heading is None:
        found, center, valid = unchecked_relative_pose_4pt(rays1, rays2, about.index_ratio, about.height)
    else:
        center, valid = unchecked_relative_pose_3pt(rays1, rays2, heading, about.index_ratio, about.height)
        found, center, valid = heading[:, None], center[:, None], valid[:, None]
    return _upright(found, center, 4), valid


def absolute_models(
    rays: Float[Tensor, "s size 3"],
    points: Float[Tensor, "s size 3"],
    heading: Float[Tensor, " s"] | None,
    about: OneView,
) -> tuple[Float[Tensor, "s m 6"], Bool[Tensor, "s m"]]:
    """Models of minimal samples of level rays and points, without tilt, and which are valid; heading: of each, where it
    is known. about: has the index ratio."""
    if heading is None:
        found, center, valid = unchecked_absolute_pose_2pt(rays, points, about.index_ratio)
    else:
        center, valid = unchecked_absolute_pose_known_heading(rays, points, heading, about.index_ratio)
        found, center, valid = heading[:, None], center[:, None], valid[:, None]
    return _upright(found, center, 2), valid


def _upright(heading: Float[Tensor, "s m"], center: Float[Tensor, "s m 3"], tilts: int) -> Float[Tensor, "s m _"]:
    """Models without tilts."""
    zeros = torch.zeros_like(heading)[..., None].expand(*heading.shape, tilts)
    return torch.cat((zeros, heading[..., None], center), dim=-1)


def level_rays(
    plane: Float[Tensor, "*#batch n 2"], cam_from_level: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Gravity-aligned rays of image-plane coordinates."""
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ cam_from_level


def optimized(
    data: PoseData[Any], models: Float[Tensor, "k d"], max_error: float, stages: Stages, thorough: bool
) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]:
    """Models refined in stages, a thorough optimisation with the limit of the noise at last, and their costs."""
    found = _Judged.of(data, models)
    refined = refine_in_stages(data, models, max_error, stages)
    found = found.unless_fewer_agree(_Judged.of(data, refined), max_error)
    if thorough:
        refined = data.refine(found.models, tightened(found.errors.squared, max_error), LAST_ITERATIONS).states
        found = found.unless_fewer_agree(_Judged.of(data, refined), max_error)
    return found.models, data.costs(found.models, max_error, found.errors)


def refine_in_stages(
    data: PoseData[Any], models: Float[Tensor, "k d"], max_error: float, stages: Stages
) -> Float[Tensor, "k d"]:
    for widened, iterations in stages:
        models = data.refine(models, widened * max_error, iterations).states
    return models


def tightened(squared_errors: Float[Tensor, "k n"], max_error: float) -> Float[Tensor, " k"]:
    """Three robust standard deviations of the errors within max_error of each model, in pixels.

    A wrong match within max_error weighs as much as many right ones. The standard deviation is 1.4826 times the median
    of what lies within, as for noise without outliers. At most max_error, and at least LEAST_LIMIT.
    """
    within = torch.where(squared_errors < max_error * max_error, squared_errors, torch.nan)
    typical = within.nanmedian(dim=-1).values.sqrt()
    return torch.where(typical.isnan(), max_error, (3.0 * 1.4826 * typical).clamp(LEAST_LIMIT, max_error))
