"""How the optimisation of pose hypotheses proceeds: from a wide limit of the errors to a narrow one."""

from collections.abc import Sequence
from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from torchrefrac.optim import SmallReport

LEAST_LIMIT = 0.05

Stages = Sequence[tuple[float, int]]
"""How far max_error is widened, and the iterations."""


class Refinable(Protocol):
    """Matches or points that models can be refined to: `TwoViews`, `OneView`."""

    def squared_errors(self, models: Float[Tensor, "k d"]) -> Float[Tensor, "k n"]: ...

    def refine(self, models: Float[Tensor, "k d"], max_error: float, max_iterations: int) -> SmallReport: ...

    def costs(self, models: Float[Tensor, "k d"], max_error: float) -> Float[Tensor, " k"]: ...


def refine_in_stages(
    data: Refinable, models: Float[Tensor, "k d"], max_error: float, stages: Stages
) -> Float[Tensor, "k d"]:
    for widened, iterations in stages:
        models = data.refine(models, widened * max_error, iterations).states
    return models


def tightened(squared_errors: Float[Tensor, "k n"], max_error: float) -> float:
    """Three robust standard deviations of the errors within max_error, in pixels.

    A wrong match within max_error weighs as much as many right ones. The standard deviation is 1.4826 times the median
    of what lies within, as for noise without outliers. At most max_error, and at least LEAST_LIMIT.
    """
    within = squared_errors[squared_errors < max_error * max_error]
    if not len(within):
        return max_error
    return min(max_error, max(3.0 * 1.4826 * float(within.median().sqrt()), LEAST_LIMIT))
