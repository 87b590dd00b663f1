"""What the estimators of a relative and of an absolute pose share: all but how a sample is solved."""

from typing import Generic, Protocol, TypeVar

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchrefrac.ransac.stages import Refinable, Stages, refine_in_stages, tightened

LAST_ITERATIONS = 6
TILT_PX = 20.0


class PoseData(Refinable, Protocol):
    """`TwoViews` or `OneView`."""

    @property
    def focal(self) -> Float[Tensor, " 2"]: ...

    @property
    def gravity_sigma(self) -> float: ...

    def __len__(self) -> int: ...

    def rows(self, rows: Shaped[Tensor, " some"]) -> "PoseData": ...

    def single(self) -> "PoseData": ...


D = TypeVar("D", bound=PoseData)


class PoseEstimator(Generic[D]):
    """Models are the rows of `data`, whose priors and errors they are refined and judged by; see `msac.Estimator`.

    quick, thorough: the stages of both depths of the optimisation; a thorough one ends with the limit of the noise.
    """

    def __init__(self, data: D, quick: Stages, thorough: Stages) -> None:
        self._data, self._single = data, data.single()
        self._quick, self._thorough = quick, thorough

    @property
    def num_data(self) -> int:
        return len(self._data)

    @property
    def samples_per_hit(self) -> float:
        """Measured: near one while the vertical is good to 10 pixels, and growing with its squared error from there."""
        return 1.0 + (self._data.gravity_sigma * float(self._data.focal.mean()) / TILT_PX) ** 2

    def squared_errors(self, models: Float[Tensor, "k d"], rows: Int[Tensor, " n"] | None) -> Float[Tensor, "k n"]:
        data = self._single if models.dtype == torch.float32 else self._data
        return (data if rows is None else data.rows(rows)).squared_errors(models)

    def optimize(
        self, models: Float[Tensor, "k d"], max_error: float, rows: Int[Tensor, " n"] | None, thorough: bool
    ) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]:
        data = self._data if rows is None else self._data.rows(rows)
        models = refine_in_stages(data, models, max_error, self._thorough if thorough else self._quick)
        if thorough:
            limit = tightened(data.squared_errors(models), max_error)
            models = data.refine(models, limit, LAST_ITERATIONS).states
        return models, data.costs(models, max_error)
