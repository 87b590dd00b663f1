"""Relative poses of many pairs of cameras at once, as `ransac_each` wants them estimated.

Every batch of samples, hypotheses and refinements is that of all pairs: most of what one pair alone costs is
to begin many small operations.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchrefrac.checks import can_be_looked_at
from torchrefrac.ransac.pose import RelativePoseEstimator, level_rays, optimized, relative_models
from torchrefrac.refinement import TwoViews

IN_CACHE = 1 << 15
"""Matches of all models that are refined at a time."""

Rows = Int[Tensor, "pairs n"] | None


class RelativePoseEstimators:
    """`RelativePoseEstimator` of each of some pairs, which have the index ratio, the height of the first camera and the
    expected error of pixels in common. See `msac.Estimators`.

    Tables are as wide as the pair with most matches: pairs should be alike in that.
    """

    def __init__(self, pairs: Sequence[TwoViews]) -> None:
        self._each = [RelativePoseEstimator(views) for views in pairs]
        first = pairs[0]
        counts = torch.tensor([len(views) for views in pairs], device=first.plane1.device)
        plane1, plane2 = (
            pad_sequence([getattr(views, name) for views in pairs], batch_first=True, padding_value=0.0)
            for name in ("plane1", "plane2")
        )
        self._counts, self._samples_per_hit = counts, [estimator.samples_per_hit for estimator in self._each]
        known = first.known_heading is not None
        self._headings = plane1.new_tensor([views.known_heading for views in pairs]) if known else None
        self._table = replace(
            first,
            plane1=plane1,
            plane2=plane2,
            cam_from_level=torch.stack([views.cam_from_level for views in pairs]),
            focal=torch.stack([views.focal.expand(2, 2) for views in pairs]),
            gravity_sigma=plane1.new_tensor([views.gravity_sigma for views in pairs]),
            exists=torch.arange(plane1.shape[1], device=counts.device) < counts[:, None],
        )
        self._rays = tuple(
            level_rays(plane, self._table.cam_from_level[:, k]) for k, plane in enumerate((plane1, plane2))
        )
        self._tables: dict[tuple[int, torch.dtype], tuple[Rows, TwoViews]] = {}

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

    def solve(
        self, samples: Int[Tensor, "s size"], owner: Int[Tensor, " s"]
    ) -> tuple[Float[Tensor, "s m 8"], Bool[Tensor, "s m"]]:
        one, two = (rays[owner[:, None], samples] for rays in self._rays)
        known = None if self._headings is None else self._headings[owner]
        return relative_models(one, two, known, self._table)

    def squared_errors(
        self, models: Float[Tensor, "k 8"], owner: Int[Tensor, " k"], rows: Rows
    ) -> Float[Tensor, "k n"]:
        return self._data(owner, rows, models.dtype).squared_errors(models)

    def optimize(
        self, models: Float[Tensor, "k 8"], owner: Int[Tensor, " k"], max_error: float, rows: Rows, thorough: bool
    ) -> tuple[Float[Tensor, "k 8"], Float[Tensor, " k"]]:
        stages = RelativePoseEstimator.thorough if thorough else RelativePoseEstimator.quick
        width = self._width(owner) if rows is None else rows.shape[1]
        parts = zip(*(part.split(max(IN_CACHE // max(width, 1), 1)) for part in (models, owner)), strict=True)
        found = [optimized(self._data(of, rows, some.dtype), some, max_error, stages, thorough) for some, of in parts]
        found, costs = zip(*found, strict=True)
        return torch.cat(found), torch.cat(costs)

    def degeneracy(self, problem: int, model: Float[Tensor, " 8"], inliers: Bool[Tensor, " n"]) -> str:
        return self._each[problem].degeneracy(model, inliers)

    def _data(self, owner: Int[Tensor, " k"], rows: Rows, dtype: torch.dtype) -> TwoViews:
        """The matches of the pair of each model."""
        table = self._matches(rows, dtype)
        width = table.plane1.shape[1] if rows is not None else max(self._width(owner), 1)
        if width < table.plane1.shape[1]:
            table = replace(table, **{name: getattr(table, name)[:, :width] for name in ("plane1", "plane2", "exists")})
        return table.of_models(owner)

    def _width(self, owner: Int[Tensor, " k"]) -> int:
        """Of a table in which the pairs of the models have room; that of all where looking would cost more."""
        return int(self._counts[owner].max()) if can_be_looked_at(owner) else self._table.plane1.shape[1]

    def _matches(self, rows: Rows, dtype: torch.dtype) -> TwoViews:
        """Those `rows` of each pair, by default all; looked up once."""
        key = id(rows), dtype
        if key not in self._tables:
            table = self._table
            if rows is not None:
                of_pair = torch.arange(len(rows), device=rows.device)[:, None]
                plane1, plane2 = (plane[of_pair, rows.clamp(min=0)] for plane in (table.plane1, table.plane2))
                table = replace(table, plane1=plane1, plane2=plane2, exists=rows >= 0)
            table = table.single() if dtype == torch.float32 else table
            self._tables[key] = rows, table  # which keeps the number of these rows from being that of others
        return self._tables[key][1]
