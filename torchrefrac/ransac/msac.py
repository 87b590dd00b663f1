"""The batched LO-MSAC loop. It draws, screens, optimises and stops; what a model is, only the estimator knows.

Whole batches of minimal samples are solved and scored at once (MSAC: sum of squared errors truncated at max_error; Torr
& Zisserman, CVIU 2000). Scoring has two stages. Every model is screened on a random part of the data, in single
precision. The leaders of the batch are optimised a little on that part, and when the best of them beats all before, it
is optimised thoroughly on all the data (local optimisation: Chum, Matas, Kittler, DAGM 2003) and judged there.
"""

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import Range, require_ranges

SCORE_ELEMENTS = 1 << 15
HOPELESS_RATIO, MISSED = 0.4, 0.01
"""Share of inliers at which data that do not look promising are given up, and the probability that a good enough sample
was missed there. Where as many are right, data look promising anyway: this is for those few that do not."""

Status = Literal["success", "too_few_data", "no_consensus", "degenerate"]


class Estimator(Protocol):
    """Models are rows of D numbers; data are numbered 0 ... num_data - 1. rows: some of the data; None: all."""

    @property
    def sample_size(self) -> int: ...

    @property
    def num_data(self) -> int: ...

    @property
    def samples_per_hit(self) -> float:
        """How many samples without outliers it takes, on average, for one that is good enough to be optimised."""
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
    """max_error in the estimator's unit (pixels for poses); confidence that a good enough sample was drawn.

    batch_size: samples of the first batch; each one after is twice as large, up to max_batch_size.
    screening_size: data that models are screened with, at screening_factor times max_error; leaders: models of a batch
    that are optimised on them.
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
        return int(self.inliers.sum())


def ransac(estimator: Estimator, options: RansacOptions, generator: torch.Generator) -> RansacReport:
    """Find the model that most data agree with.

    Deterministic for a given state of `generator`. Fails with a status, not with a model: "too_few_data";
    "no_consensus", fewer than min_inliers data agree; "degenerate", they agree but do not determine it. Drawing ends
    when so many samples were drawn that with `confidence` a good enough one was among them, at the best inlier ratio
    so far, or at that of the fewest inliers that are enough, if that is higher: with few data, chance ends soon. Data
    that do not look promising are given up much earlier, if the first batch has found nothing in them.
    """
    needed = max(estimator.sample_size + 1, options.min_inliers)
    if estimator.num_data < needed:
        detail = f"there are only {estimator.num_data} data, but {needed} must agree"
        nothing = torch.zeros(estimator.num_data, dtype=torch.bool)
        return RansacReport("too_few_data", torch.zeros(0), nothing, math.inf, 0, detail)
    search = _Search(estimator, options, generator, needed)
    size = options.batch_size
    while (left := search.left) > 0:
        search.batch(min(size, left))
        size = min(2 * size, options.max_batch_size)
    return search.report(needed)


class _Search:
    """The best model so far, what it explains, and how many samples are wanted because of it."""

    def __init__(self, estimator: Estimator, options: RansacOptions, generator: torch.Generator, needed: int) -> None:
        self.estimator, self.options, self.generator = estimator, options, generator
        self.least = needed / estimator.num_data
        self.drawn, self.wanted = 0, max(self._samples_at(self.least, options.confidence), options.batch_size)
        self.model = torch.zeros(0)
        self.inliers = torch.zeros(estimator.num_data, dtype=torch.bool)
        self.cost = self.screened_cost = math.inf
        self.rows: Int[Tensor, " n"] | None = None
        if estimator.num_data > 2 * options.screening_size:
            self.rows = torch.randperm(estimator.num_data, generator=generator)[: options.screening_size]

    @property
    def left(self) -> int:
        """How many samples are still to be drawn."""
        left = min(self.wanted, self.options.max_samples) - self.drawn
        if left <= 0 or self.drawn == 0 or self.estimator.is_promising:
            return left
        return min(left, self._samples_at(HOPELESS_RATIO, 1.0 - MISSED) - self.drawn)

    def batch(self, count: int) -> None:
        """Draw, solve, screen; optimise the leaders, and the best of them on all data if none before was as good."""
        estimator = self.estimator
        samples = draw_samples(count, estimator.num_data, estimator.sample_size, self.generator)
        models, valid = estimator.solve(samples)
        self.drawn += count
        models = models[valid]
        if not len(models):
            return
        scores = self._scores(models)
        leaders = models[scores.topk(min(self.options.leaders, len(models)), largest=False).indices]
        leaders, costs = estimator.optimize(leaders, self.options.max_error, self.rows, thorough=False)
        cost, index = costs.min(dim=0)
        if float(cost) >= self.screened_cost:
            return
        self.screened_cost = float(cost)
        best, costs = estimator.optimize(leaders[index][None], self.options.max_error, None, thorough=True)
        if float(costs[0]) < self.cost:
            self._take(best[0], float(costs[0]))

    def report(self, needed: int) -> RansacReport:
        count = int(self.inliers.sum())
        if count < needed:
            detail = f"only {count} of {self.estimator.num_data} data agree with the best model, but {needed} must"
            return self._without_model("no_consensus", detail)
        detail = self.estimator.degeneracy(self.model, self.inliers)
        if detail:
            return self._without_model("degenerate", detail)
        return RansacReport("success", self.model, self.inliers, self.cost, self.drawn)

    def _without_model(self, status: Status, detail: str) -> RansacReport:
        return RansacReport(status, self.model[:0], self.inliers, self.cost, self.drawn, detail)

    def _scores(self, models: Float[Tensor, "k d"]) -> Float[Tensor, " k"]:
        """Truncated sums of squared errors of the screening data."""
        limit = (self.options.screening_factor * self.options.max_error) ** 2
        size = self.estimator.num_data if self.rows is None else len(self.rows)
        parts = models.float().split(max(1, SCORE_ELEMENTS // size))
        return torch.cat(
            [self.estimator.squared_errors(part, self.rows).clamp(max=limit).sum(dim=-1) for part in parts]
        )

    def _take(self, model: Float[Tensor, " d"], cost: float) -> None:
        self.model, self.cost = model, cost
        self.inliers = self.estimator.squared_errors(model[None], None)[0] < self.options.max_error**2
        self.wanted = self._samples_at(max(float(self.inliers.double().mean()), self.least), self.options.confidence)

    def _samples_at(self, ratio: float, confidence: float) -> int:
        """How many samples are enough, with this confidence, where this share of the data are inliers."""
        hits = ratio**self.estimator.sample_size / self.estimator.samples_per_hit
        if hits >= 1.0:
            return 0
        if hits <= 0.0:  # nothing is known of the vertical
            return self.options.max_samples
        return min(math.ceil(math.log(1.0 - confidence) / math.log1p(-hits)), self.options.max_samples)


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
