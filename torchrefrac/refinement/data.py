"""What models of poses are refined on: matches of two cameras, or points that one camera sees; of many problems too."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import Field, replace
from functools import cached_property
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, Self, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchrefrac.optim import Quadratic, SmallReport
from torchrefrac.refinement.tilt import Limit, Priors, Sigma

OWN = ("cam_from_level", "focal", "gravity_sigma", "known_heading", "exists")
Models = Float[Tensor, "h d"]


class Errors(Protocol):
    """Named tuples of what the data are like under models, of which squared errors follow."""

    @property
    def squared(self) -> Float[Tensor, "h n"]:
        """In squared pixels; inf where a datum is impossible or does not exist."""
        ...


E = TypeVar("E", bound=Errors)


class PoseData(ABC, Generic[E]):
    """Of one problem, whatever the models are; or each model has one of its own: data, verticals, focal lengths,
    gravity_sigma and known_heading then have a first dimension for the models, and `exists` says which data there are,
    where a problem has fewer than the table.

    Its kinds are dataclasses with these fields, and with tensors that have a row for each datum, named by `DATA`; their
    models have `UNKNOWNS` numbers.
    """

    DATA: ClassVar[tuple[str, ...]]
    UNKNOWNS: ClassVar[int]
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    cam_from_level: Float[Tensor, "*own_view 3 3"]
    focal: Float[Tensor, "*own_view 2"]
    index_ratio: Float[Tensor, ""]
    gravity_sigma: Sigma
    pixel_sigma: float
    known_heading: Sigma | None
    exists: Bool[Tensor, "own n"] | None

    @classmethod
    def together(cls, each: Sequence[Self]) -> Self:
        """Some problems as those of as many models, in a table as wide as the longest; what problems cannot have of
        their own is that of the first. Raises ValueError where the heading of some is known and of others not."""
        first, headings = each[0], [one.known_heading for one in each]
        if len({heading is None for heading in headings}) > 1:
            raise ValueError("known_heading must be stated for all problems or for none")
        counts = torch.tensor([len(one) for one in each], device=first.focal.device)
        tables = {name: pad_sequence([getattr(one, name) for one in each], batch_first=True) for name in cls.DATA}
        return replace(
            first,
            **tables,
            cam_from_level=torch.stack([one.cam_from_level for one in each]),
            focal=torch.stack([one.focal.expand(*one.cam_from_level.shape[:-2], 2) for one in each]),
            gravity_sigma=first.focal.new_tensor([one.gravity_sigma for one in each]),
            known_heading=None if None in headings else first.focal.new_tensor(headings),
            exists=torch.arange(max(map(len, each)), device=counts.device) < counts[:, None],
        )

    def __len__(self) -> int:
        return getattr(self, self.DATA[0]).shape[-2]

    def rows(self, rows: Shaped[Tensor, " some"]) -> Self:
        """Some of the data of one problem."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self.DATA})

    def rows_of_each(self, rows: Int[Tensor, "own n"]) -> Self:
        """Some of the data of each model: -1 for none."""
        model = torch.arange(len(rows), device=rows.device)[:, None]
        some = {name: getattr(self, name)[model, rows.clamp(min=0)] for name in self.DATA}
        return replace(self, **some, exists=rows >= 0)

    def no_wider_than(self, width: int) -> Self:
        """Of each model the first data."""
        if self.exists is None or width >= len(self):
            return self
        return replace(self, **{name: getattr(self, name)[:, :width] for name in (*self.DATA, "exists")})

    def of_models(self, models: Int[Tensor, " some"]) -> Self:
        """What some of the models have, where each has its own."""
        if self.exists is None:
            return self
        own = {name: getattr(self, name) for name in (*self.DATA, *OWN)}
        return replace(self, **{name: of[models] for name, of in own.items() if isinstance(of, Tensor)})

    def single(self) -> Self:
        """The same in single precision: enough to tell hypotheses apart."""
        names = (*self.DATA, "cam_from_level", "focal", "index_ratio")
        return replace(self, **{name: getattr(self, name).float() for name in names})

    @abstractmethod
    def errors(self, models: Models) -> E:
        """Of the data under models."""

    @abstractmethod
    def costs_of(self, errors: E, max_error: Limit) -> Float[Tensor, " h"]:
        """Truncated sums of squared errors in pixels."""

    def squared_errors(self, models: Models) -> Float[Tensor, "h n"]:
        """In squared pixels; inf where a datum is impossible or does not exist."""
        return self.errors(models).squared

    def costs(self, models: Models, max_error: Limit, errors: E | None = None) -> Float[Tensor, " h"]:
        """Truncated sums of squared errors in pixels, and the priors. errors: those under the models, where they are
        known."""
        errors = self.errors(models) if errors is None else errors
        return self.costs_of(errors, max_error) + 2.0 * self.priors.costs(models)

    @abstractmethod
    def linearize(self, models: Models, max_error: Limit, active: Bool[Tensor, "h n"] | None = None) -> Quadratic:
        """The cost in squared pixels, half a sum, and its quadratic model. active: data that count, by default all."""

    @abstractmethod
    def refine(self, models: Models, max_error: Limit, max_iterations: int, tolerance: float = 1e-6) -> SmallReport:
        """Minimise the truncated cost from models; data beyond max_error, pixels, do not count."""

    @cached_property
    def priors(self) -> Priors:
        """On models: gravity, the heading."""
        known = self.known_heading is not None
        return Priors.of(self.gravity_sigma, self.pixel_sigma, known, self.UNKNOWNS, self.focal)

    def _sum(self, values: Float[Tensor, "h n"]) -> Float[Tensor, " h"]:
        """Over the data that there are."""
        return (values if self.exists is None else torch.where(self.exists, values, 0.0)).sum(dim=-1)


class Costs(NamedTuple):
    """Those of models, as `Separable` problems. active: which data count for each, by default all."""

    data: PoseData[Any]
    max_error: Limit
    active: Bool[Tensor, "h n"] | None = None

    def linearize(self, states: Models) -> Quadratic:
        return self.data.linearize(states, self.max_error, self.active)

    def subset(self, rows: Int[Tensor, " some"]) -> "Costs":
        limit = self.max_error[rows] if isinstance(self.max_error, Tensor) else self.max_error
        return Costs(self.data.of_models(rows), limit, None if self.active is None else self.active[rows])
