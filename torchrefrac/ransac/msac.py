"""The batched LO-MSAC loop. It draws, screens, optimises and stops; what a model is, only the estimator knows.

Whole batches of minimal samples are solved and scored at once (MSAC: sum of squared errors truncated at max_error; Torr
& Zisserman, CVIU 2000). Scoring has two stages. Every model is screened on a random part of the data, in single
precision. The leaders of the batch are optimised a little on that part, and when the best of them beats all before, it
is optimised thoroughly on all the data (local optimisation: Chum, Matas, Kittler, DAGM 2003) and judged there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.checks import Range, require_ranges

SCORE_ELEMENTS = 1 << 16
HOPELESS_RATIO, MISSED = 0.4, 0.01
"""Share of inliers at which data that do not look promising are given up, and the probability that a good enough sample
was missed there. Where as many are right, data look promising anyway: this is for those few that do not."""

Status = Literal["success", "too_few_data", "no_consensus", "degenerate"]


class Estimator(Protocol):
    """Models are rows of D numbers; data are numbered 0 ... num_data - 1. rows: some of the data; None: all. Errors,
    and max_error, are in a unit of its own: pixels for poses."""

    @property
    def sample_size(self) -> int:
        """How many data a minimal sample has."""
        ...

    @property
    def num_data(self) -> int:
        """How many data there are."""
        ...

    @property
    def samples_per_hit(self) -> float:
        """How many samples without outliers it takes, on average, for one that is good enough to be optimised."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the data are."""
        ...

    @property
    def is_promising(self) -> bool:
        """Whether more data look right, before any model is known, than wrong ones do by chance. True where nothing can
        be seen without a model."""
        ...

    def solve(self, samples: Int[Tensor, "s size"]) -> tuple[Float[Tensor, "s m d"], Bool[Tensor, "s m"]]:
        """Candidates of minimal samples: models, valid."""
        ...

    def squared_errors(self, models: Float[Tensor, "k d"], rows: Int[Tensor, " n"] | None) -> Float[Tensor, "k n"]:
        """Squared error of each datum under each model, in the precision of the models. Infinite where impossible."""
        ...

    def optimize(
        self, models: Float[Tensor, "k d"], max_error: float, rows: Int[Tensor, " n"] | None, thorough: bool
    ) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]:
        """Models improved on the data, and their costs: what the score is, and priors.

        thorough: to convergence; otherwise as far as it takes to tell good starts from bad.
        """
        ...

    def degeneracy(self, model: Float[Tensor, " d"], inliers: Bool[Tensor, " n"]) -> str:
        """Why the inliers do not determine the model, in a sentence; empty if they do."""
        ...


class Estimators(Protocol):
    """Many problems at once, numbered from 0; what `Estimator` says holds for each. owner: which one each sample or
    model is of, ascending."""

    @property
    def sample_size(self) -> int: ...

    @property
    def num_data(self) -> Sequence[int]: ...

    @property
    def samples_per_hit(self) -> Sequence[float]: ...

    @property
    def device(self) -> torch.device: ...

    def is_promising(self, problem: int) -> bool: ...

    def solve(
        self, samples: Int[Tensor, "s size"], owner: Int[Tensor, " s"]
    ) -> tuple[Float[Tensor, "s m d"], Bool[Tensor, "s m"]]: ...

    def squared_errors(
        self, models: Float[Tensor, "k d"], owner: Int[Tensor, " k"], rows: Int[Tensor, "problems n"] | None
    ) -> Float[Tensor, "k n"]:
        """Infinite also where a problem has fewer data than the table; rows: -1 for none."""
        ...

    def optimize(
        self,
        models: Float[Tensor, "k d"],
        owner: Int[Tensor, " k"],
        max_error: float,
        rows: Int[Tensor, "problems n"] | None,
        thorough: bool,
    ) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]: ...

    def degeneracies(
        self, models: Float[Tensor, "k d"], owner: Int[Tensor, " k"], inliers: Bool[Tensor, "k n"]
    ) -> list[str]:
        """`Estimator.degeneracy` of each model."""
        ...


RANGES = {
    "max_error": Range(above=0.0, at_most=1e6),
    "confidence": Range(at_least=0.0),
    **dict.fromkeys(
        ("batch_size", "max_batch_size", "screening_size", "leaders"), Range(at_least=1, at_most=1_000_000)
    ),
    **dict.fromkeys(("max_samples", "min_inliers"), Range(at_least=1, at_most=1e9)),
    "screening_factor": Range(at_least=1.0, at_most=1e6),
}


@dataclass(frozen=True)
class RansacOptions:
    """How long is searched, and what agrees: max_error in the estimator's unit (pixels for poses); confidence that a
    good enough sample was drawn.

    batch_size: samples of the first batch; each one after is twice as large, up to max_batch_size.
    screening_size: data that models are screened with, at screening_factor times max_error; leaders: models of a batch
    that are optimised on them.

    Raises ValueError for values that cannot be right.
    """

    max_error: float = 4.0
    confidence: float = 0.9999
    batch_size: int = 192
    max_batch_size: int = 1024
    max_samples: int = 24576
    screening_size: int = 256
    screening_factor: float = 2.0
    leaders: int = 8
    min_inliers: int = 12

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)
        if self.confidence >= 1.0:
            raise ValueError(f"confidence is {self.confidence:g}, but must be below 1: no number of samples is certain")


@dataclass(frozen=True)
class RansacReport:
    """What came out. `model` and `inliers` of a success; otherwise the model is empty.

    inliers and cost are those of the best model also where there were too few of them, or they did not determine it;
    `detail` says why in a sentence.
    """

    status: Status
    model: Float[Tensor, " d"]
    inliers: Bool[Tensor, " n"]
    cost: float
    num_samples: int
    detail: str = ""

    @property
    def num_inliers(self) -> int:
        """How many data agree."""
        return int(self.inliers.sum())


def ransac(estimator: Estimator, options: RansacOptions, generator: torch.Generator) -> RansacReport:
    """Find the model that most data agree with.

    Deterministic for a given state of `generator`. Fails with a status, not with a model: "too_few_data";
    "no_consensus", fewer than min_inliers data agree; "degenerate", they agree but do not determine it. Drawing ends
    when so many samples were drawn that with `confidence` a good enough one was among them, at the best inlier ratio
    so far, or at that of the fewest inliers that are enough, if that is higher: with few data, chance ends soon. Data
    that do not look promising are given up much earlier, if the first batch has found nothing in them.
    """
    return ransac_each(_Alone(estimator), options, [generator])[0]


def ransac_each(
    estimators: Estimators, options: RansacOptions, generators: Sequence[torch.Generator]
) -> list[RansacReport]:
    """`ransac` of many problems, whose batches are one; each draws from a generator of its own, as many samples as it
    needs, and does not see the others."""
    searches = [_Search(estimators, problem, options, generator) for problem, generator in enumerate(generators)]
    rows = _screened(searches, estimators.device)
    while active := [search for search in searches if search.left > 0]:
        _batch(estimators, active, rows, options)
    return _reports(estimators, searches)


@dataclass(frozen=True)
class _Alone:
    """One problem as the only one of many."""

    estimator: Estimator

    @property
    def sample_size(self) -> int:
        return self.estimator.sample_size

    @property
    def num_data(self) -> Sequence[int]:
        return [self.estimator.num_data]

    @property
    def samples_per_hit(self) -> Sequence[float]:
        return [self.estimator.samples_per_hit]

    @property
    def device(self) -> torch.device:
        return self.estimator.device

    def is_promising(self, problem: int) -> bool:
        return self.estimator.is_promising

    def solve(
        self, samples: Int[Tensor, "s size"], owner: Int[Tensor, " s"]
    ) -> tuple[Float[Tensor, "s m d"], Bool[Tensor, "s m"]]:
        return self.estimator.solve(samples)

    def squared_errors(
        self, models: Float[Tensor, "k d"], owner: Int[Tensor, " k"], rows: Int[Tensor, "1 n"] | None
    ) -> Float[Tensor, "k n"]:
        return self.estimator.squared_errors(models, None if rows is None else rows[0])

    def optimize(
        self,
        models: Float[Tensor, "k d"],
        owner: Int[Tensor, " k"],
        max_error: float,
        rows: Int[Tensor, "1 n"] | None,
        thorough: bool,
    ) -> tuple[Float[Tensor, "k d"], Float[Tensor, " k"]]:
        return self.estimator.optimize(models, max_error, None if rows is None else rows[0], thorough)

    def degeneracies(
        self, models: Float[Tensor, "k d"], owner: Int[Tensor, " k"], inliers: Bool[Tensor, "k n"]
    ) -> list[str]:
        return [self.estimator.degeneracy(*found) for found in zip(models, inliers, strict=True)]


class _Search:
    """The best model of one problem so far, what it explains, and how many samples are wanted because of it."""

    def __init__(
        self, estimators: Estimators, problem: int, options: RansacOptions, generator: torch.Generator
    ) -> None:
        self.estimators, self.problem, self.options, self.generator = estimators, problem, options, generator
        self.count = estimators.num_data[problem]
        self.needed = max(estimators.sample_size + 1, options.min_inliers)
        self.enough = self.count >= self.needed
        self.least = self.needed / max(self.count, 1)
        self.size, self.drawn, self.wanted = options.batch_size, 0, 0
        self.model = torch.zeros(0, device=estimators.device)
        self.inliers = torch.zeros(self.count, dtype=torch.bool, device=estimators.device)
        self.agreeing = 0
        self.cost = self.screened_cost = math.inf
        self.rows: Int[Tensor, " n"] | None = None
        if self.enough:
            self.wanted = max(self._samples_at(self.least, options.confidence), options.batch_size)
            if self.count > 2 * options.screening_size:
                self.rows = torch.randperm(self.count, generator=generator)[: options.screening_size]

    @property
    def left(self) -> int:
        """How many samples are still to be drawn."""
        left = min(self.wanted, self.options.max_samples) - self.drawn
        if left <= 0 or self.drawn == 0 or self.estimators.is_promising(self.problem):
            return left
        return min(left, self._samples_at(HOPELESS_RATIO, 1.0 - MISSED) - self.drawn)

    def draw(self) -> Int[Tensor, "s size"]:
        """The samples of its next batch, twice as many as in the one before."""
        count = min(self.size, self.left)
        self.size = min(2 * self.size, self.options.max_batch_size)
        self.drawn += count
        return draw_samples(count, self.count, self.estimators.sample_size, self.generator)

    def take(self, model: Float[Tensor, " d"], cost: float, inliers: Bool[Tensor, " n"], agreeing: int) -> None:
        """agreeing: how many the inliers are."""
        self.model, self.cost, self.inliers, self.agreeing = model, cost, inliers, agreeing
        self.wanted = self._samples_at(max(agreeing / self.count, self.least), self.options.confidence)

    @property
    def agrees(self) -> bool:
        """Whether enough data agree with the best model."""
        return self.agreeing >= self.needed

    def report(self, degeneracy: str) -> RansacReport:
        """degeneracy: why the inliers do not determine the model."""
        if not self.enough:
            detail = f"there are only {self.count} data, but {self.needed} must agree"
            return self._without_model("too_few_data", detail)
        if not self.agrees:
            detail = f"only {self.agreeing} of {self.count} data agree with the best model, but {self.needed} must"
            return self._without_model("no_consensus", detail)
        if degeneracy:
            return self._without_model("degenerate", degeneracy)
        return RansacReport("success", self.model, self.inliers, self.cost, self.drawn)

    def _without_model(self, status: Status, detail: str) -> RansacReport:
        return RansacReport(status, self.model[:0], self.inliers, self.cost, self.drawn, detail)

    def _samples_at(self, ratio: float, confidence: float) -> int:
        """How many samples are enough, with this confidence, where this share of the data are inliers."""
        hits = ratio**self.estimators.sample_size / self.estimators.samples_per_hit[self.problem]
        if hits >= 1.0:
            return 0
        if hits <= 0.0:  # nothing is known of the vertical
            return self.options.max_samples
        return min(math.ceil(math.log(1.0 - confidence) / math.log1p(-hits)), self.options.max_samples)


def _reports(estimators: Estimators, searches: Sequence[_Search]) -> list[RansacReport]:
    """How the searches ended."""
    reasons = [""] * len(searches)
    if agreeing := [search for search in searches if search.agrees]:
        models = torch.stack([search.model for search in agreeing])
        owner = torch.tensor([search.problem for search in agreeing], device=models.device)
        inliers = torch.nn.utils.rnn.pad_sequence([search.inliers for search in agreeing], batch_first=True)
        for search, why in zip(agreeing, estimators.degeneracies(models, owner, inliers), strict=True):
            reasons[search.problem] = why
    return [search.report(why) for search, why in zip(searches, reasons, strict=True)]


def _screened(searches: Sequence[_Search], device: torch.device) -> Int[Tensor, "problems n"] | None:
    """Which data models of each problem are screened with, -1 where it has fewer; None: with all, in every problem."""
    if all(search.rows is None for search in searches):
        return None
    rows = [
        torch.arange(each.count, device=each.generator.device) if each.rows is None else each.rows for each in searches
    ]
    return torch.nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=-1).to(device)


def _batch(
    estimators: Estimators, searches: Sequence[_Search], rows: Int[Tensor, "problems n"] | None, options: RansacOptions
) -> None:
    """Draw, solve, screen; optimise the leaders of each problem, and the best of them on all data if none before was as
    good."""
    samples = [search.draw() for search in searches]
    of_sample = torch.cat(
        [some.new_full((len(some),), each.problem) for some, each in zip(samples, searches, strict=True)]
    )
    of_sample = of_sample.to(estimators.device)
    models, valid = estimators.solve(torch.cat(samples).to(estimators.device), of_sample)
    sample, candidate = valid.nonzero(as_tuple=True)
    models, owner = models[sample, candidate], of_sample[sample]
    if not len(models):
        return
    first = _lowest_of_each(_scores(estimators, models, owner, rows, options), owner, options.leaders)
    owner = owner[first]
    leaders, costs = estimators.optimize(models[first], owner, options.max_error, rows, thorough=False)
    best = _lowest_of_each(costs, owner, 1)
    by_problem = {search.problem: search for search in searches}
    better = []
    for row, problem, cost in _looked_at(best, owner[best], costs[best]):
        search = by_problem[int(problem)]
        if cost < search.screened_cost:
            search.screened_cost = cost
            better.append(int(row))
    if not better:
        return
    rows_of = torch.tensor(better, device=owner.device)
    owner = owner[rows_of]
    found, costs = estimators.optimize(leaders[rows_of], owner, options.max_error, None, thorough=True)
    agree = estimators.squared_errors(found, owner, None) < options.max_error**2
    for i, (problem, cost, agreeing) in enumerate(_looked_at(owner, costs, agree.sum(dim=1))):
        search = by_problem[int(problem)]
        if cost < search.cost:
            search.take(found[i], cost, agree[i, : search.count], int(agreeing))


def _looked_at(*columns: Shaped[Tensor, " k"]) -> list[list[float]]:
    """The rows of a table of numbers: one look at a GPU."""
    return torch.stack([column.double() for column in columns], dim=1).tolist()


def _scores(
    estimators: Estimators,
    models: Float[Tensor, "k d"],
    owner: Int[Tensor, " k"],
    rows: Int[Tensor, "problems n"] | None,
    options: RansacOptions,
) -> Float[Tensor, " k"]:
    """Truncated sums of squared errors of the screening data."""
    limit = (options.screening_factor * options.max_error) ** 2
    size = max(1, SCORE_ELEMENTS // (max(estimators.num_data) if rows is None else rows.shape[1]))
    return torch.cat(
        [
            estimators.squared_errors(some, of, rows).clamp(max=limit).sum(dim=-1)
            for some, of in zip(models.float().split(size), owner.split(size), strict=True)
        ]
    )


def _lowest_of_each(costs: Float[Tensor, " k"], owner: Int[Tensor, " k"], count: int) -> Int[Tensor, " some"]:
    """The rows of the lowest costs of each problem, at most so many, by problem and cost. owner ascends."""
    order = costs.argsort(stable=True)
    order = order[owner[order].argsort(stable=True)]
    rank = torch.arange(len(owner), device=owner.device) - torch.searchsorted(owner, owner)  # from the first of its own
    return order[rank < count]


def draw_samples(count: int, num_data: int, size: int, generator: torch.Generator) -> Int[Tensor, "{count} {size}"]:
    """Uniform random subsets of 0 ... num_data - 1.

    Floyd's algorithm (Bentley & Floyd, CACM 1987): of the numbers up to j one is drawn, and j itself is taken in place
    of one that is in the sample already. On the device of the generator.
    """
    samples = torch.empty(count, size, dtype=torch.long, device=generator.device)
    for k in range(size):
        j = num_data - size + k
        drawn = torch.randint(j + 1, (count,), generator=generator, device=generator.device)
        taken = (samples[:, :k] == drawn[:, None]).any(dim=-1)
        samples[:, k] = torch.where(taken, j, drawn)
    return samples
