"""Poses of many pairs of cameras, or of many views, at once, as `ransac_each` wants them estimated.

Every batch of samples, hypotheses and refinements is that of all problems: most of what one problem alone costs is
to begin many small operations.
"""

from collections.abc import Iterator, Sequence
from typing import Generic

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchrefrac.checks import can_be_looked_at
from torchrefrac.ransac.pose import (
    AbsolutePoseEstimator,
    D,
    PoseEstimator,
    RelativePoseEstimator,
    absolute_models,
    level_rays,
    optimized,
    relative_models,
)
from torchrefrac.refinement import OneView, TwoViews

IN_CACHE = 1 << 15
"""Data of all models that are refined at a time."""

Rows = Int[Tensor, "problems n"] | None


class PoseEstimators(Generic[D]):
    """Some estimators of poses as one; see `msac.Estimators`. Tables are as wide as the problem with most data: they
    should be alike in that."""

    def __init__(self, each: Sequence[PoseEstimator[D]]) -> None:
        self._each = each
        self._table = type(each[0].data).together([estimator.data for estimator in each])
        self._counts = torch.tensor(self.num_data, device=self._table.focal.device)
        self._samples_per_hit = [estimator.samples_per_hit for estimator in each]
        self._tables: dict[tuple[int, torch.dtype], tuple[Rows, D]] = {}

    @property
    def sample_size(self) -> int:
        return self._each[0].sample_size

    @property
    def num_data(self) -> Sequence[int]:
        return [estimator.num_data for estimator in self._each]

    @property
    def samples_per_hit(self) -> Sequence[float]:
        return self._samples_per_hit

    @property
    def device(self) -> torch.device:
        return self._counts.device

    def is_promising(self, problem: int) -> bool:
        return self._each[problem].is_promising

    def squared_errors(
        self, models: Float[Tensor, "k d"], owner: Int[Tensor, " k"], rows: Rows
    ) -> Float[Tensor, "k n"]:
        return self._data(owner, rows, models.dtype).squared_errors(models)

    def optimize(
        self, models: Float[Tensor, "k d"], owner: Int[Tensor, " k"], max_error: float, rows: Rows, thorough: bool
    ) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]:
        stages = self._each[0].thorough if thorough else self._each[0].quick
        width = self._width(owner) if rows is None else rows.shape[1]
        found = [
            optimized(self._data(of, rows, some.dtype), some, max_error, stages, thorough)
            for some, of in _in_cache(width, models, owner)
        ]
        found, costs = zip(*found, strict=True)
        return torch.cat(found), torch.cat(costs)

    def degeneracies(
        self, models: Float[Tensor, "k d"], owner: Int[Tensor, " k"], inliers: Bool[Tensor, "k n"]
    ) -> list[str]:
        of_each = inliers.nonzero()[:, 1].split(inliers.sum(dim=1).tolist())
        rows = pad_sequence(list(of_each), batch_first=True, padding_value=-1)
        return [
            why
            for some, of, agreeing in _in_cache(rows.shape[1], models, owner, rows)
            for why in self._each[0].explain(self._table.of_models(of).rows_of_each(agreeing), some)
        ]

    def _data(self, owner: Int[Tensor, " k"], rows: Rows, dtype: torch.dtype) -> D:
        """Those of the problem of each model."""
        table = self._of_problems(rows, dtype)
        if rows is None:
            table = table.no_wider_than(max(self._width(owner), 1))
        return table.of_models(owner)

    def _width(self, owner: Int[Tensor, " k"]) -> int:
        """Of a table in which the problems of the models have room; that of all where looking would cost more."""
        return int(self._counts[owner].max()) if can_be_looked_at(owner) else len(self._table)

    def _of_problems(self, rows: Rows, dtype: torch.dtype) -> D:
        """Those `rows` of each problem, by default all; looked up once."""
        key = id(rows), dtype
        if key not in self._tables:
            table = self._table if rows is None else self._table.rows_of_each(rows)
            table = table.single() if dtype == torch.float32 else table
            self._tables[key] = rows, table  # which keeps the number of these rows from being that of others
        return self._tables[key][1]

    def _headings(self, owner: Int[Tensor, " s"]) -> Float[Tensor, " s"] | None:
        """Of the problem of each sample, where they are known."""
        known = self._table.known_heading
        return known[owner] if isinstance(known, Tensor) else None


def _in_cache(width: int, *tensors: Shaped[Tensor, "k ..."]) -> Iterator[tuple[Shaped[Tensor, "some ..."], ...]]:
    """Parts of what models have, with so many data each."""
    return zip(*(tensor.split(max(IN_CACHE // max(width, 1), 1)) for tensor in tensors), strict=True)


class RelativePoseEstimators(PoseEstimators[TwoViews]):
    """`RelativePoseEstimator` of each of some pairs, which have the index ratio, the height of the first camera and the
    expected error of pixels in common."""

    def __init__(self, pairs: Sequence[TwoViews]) -> None:
        super().__init__([RelativePoseEstimator(views) for views in pairs])
        planes, levels = (self._table.plane1, self._table.plane2), self._table.cam_from_level.unbind(dim=1)
        self._rays = tuple(level_rays(plane, level) for plane, level in zip(planes, levels, strict=True))

    def solve(
        self, samples: Int[Tensor, "s size"], owner: Int[Tensor, " s"]
    ) -> tuple[Float[Tensor, "s m 8"], Bool[Tensor, "s m"]]:
        one, two = (rays[owner[:, None], samples] for rays in self._rays)
        return relative_models(one, two, self._headings(owner), self._table)


class AbsolutePoseEstimators(PoseEstimators[OneView]):
    """`AbsolutePoseEstimator` of each of some views, which have the index ratio and the expected error of pixels in
    common."""

    def __init__(self, views: Sequence[OneView]) -> None:
        super().__init__([AbsolutePoseEstimator(view) for view in views])
        self._rays = level_rays(self._table.plane, self._table.cam_from_level)

    def solve(
        self, samples: Int[Tensor, "s 2"], owner: Int[Tensor, " s"]
    ) -> tuple[Float[Tensor, "s m 6"], Bool[Tensor, "s m"]]:
        rays, points = (part[owner[:, None], samples] for part in (self._rays, self._table.points))
        return absolute_models(rays, points, self._headings(owner), self._table)
