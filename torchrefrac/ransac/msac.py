"""The batched MSAC loop. It draws, scores, refits and stops; what a model is, only the estimator knows."""

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

SCORE_ELEMENTS = 1 << 17


class Estimator(Protocol):
    """Models are rows of D numbers; data are numbered 0 ... num_data - 1."""

    @property
    def sample_size(self) -> int: ...

    @property
    def num_data(self) -> int: ...

    def solve(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Candidates of minimal samples (S, sample_size): models (S, M, D), valid (S, M)."""
        ...

    def squared_errors(self, models: Tensor) -> Tensor:
        """Squared error of each datum under each model: (H, D) -> (H, num_data); inf where impossible."""
        ...

    def refit(self, model: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
        """Candidates fitted to all `inliers` (num_data) of `model` (D): models (M, D), valid (M).

        Asked only with more inliers than a sample has.
        """
        ...


@dataclass(frozen=True)
class RansacOptions:
    """max_error in the estimator's unit (pixels for poses); confidence that an all-inlier sample was drawn."""

    max_error: float = 4.0
    confidence: float = 0.9999
    batch_size: int = 32
    min_samples: int = 32
    max_samples: int = 3072
    refits: int = 5
    min_inliers: int = 12


@dataclass(frozen=True)
class RansacReport:
    """What came out. `model` (D) and `inliers` (num_data) are those of the best model, also without consensus."""

    status: Literal["success", "too_few_data", "no_consensus"]
    model: Tensor
    inliers: Tensor
    score: float
    num_samples: int

    @property
    def num_inliers(self) -> int:
        return int(self.inliers.sum())


def ransac(estimator: Estimator, options: RansacOptions, generator: torch.Generator) -> RansacReport:
    """Find the model with the least sum of squared errors truncated at `max_error` (MSAC).

    Whole batches of samples are solved and scored at once. When a batch improves the best model, that model is
    refitted to its inliers for as long as this improves it. Drawing stops once a sample without outliers has been
    seen with `confidence` at the best inlier ratio. Deterministic for a given state of `generator`.
    Fails ("no_consensus") when fewer than `min_inliers` data agree; "too_few_data" when there are not that many.
    """
    needed = max(estimator.sample_size, options.min_inliers)
    if estimator.num_data < needed:
        none = torch.zeros(estimator.num_data, dtype=torch.bool)
        return RansacReport("too_few_data", torch.zeros(0), none, math.inf, 0)
    best = _Best()
    drawn, wanted = 0, options.max_samples
    while drawn < max(wanted, options.min_samples) and drawn < options.max_samples:
        count = min(options.batch_size, options.max_samples - drawn)
        keys = torch.rand(count, estimator.num_data, generator=generator)
        samples = keys.topk(estimator.sample_size, dim=-1).indices
        models, valid = estimator.solve(samples)
        drawn += count
        if best.improve(estimator, models[valid], options.max_error):
            _refit(best, estimator, options)
            wanted = _samples_needed(best.num_inliers / estimator.num_data, estimator.sample_size, options)
    if best.model is None or best.inliers is None:
        none = torch.zeros(estimator.num_data, dtype=torch.bool)
        return RansacReport("no_consensus", torch.zeros(0), none, math.inf, drawn)
    status = "success" if best.num_inliers >= needed else "no_consensus"
    return RansacReport(status, best.model, best.inliers, best.score, drawn)


class _Best:
    """The best model so far and what it explains."""

    def __init__(self) -> None:
        self.model: Tensor | None = None
        self.inliers: Tensor | None = None
        self.score = math.inf
        self.num_inliers = 0

    def improve(self, estimator: Estimator, models: Tensor, max_error: float) -> bool:
        """Take the best of `models` (H, D) if it beats this one."""
        if not len(models):
            return False
        limit = max_error * max_error
        chunk = max(1, SCORE_ELEMENTS // estimator.num_data)
        improved = False
        for part in models.split(chunk):
            errors = estimator.squared_errors(part)
            score, index = errors.clamp(max=limit).sum(dim=-1).min(dim=0)
            if float(score) < self.score:
                self.score = float(score)
                self.model = part[index]
                self.inliers = errors[index] < limit
                improved = True
        if improved and self.inliers is not None:
            self.num_inliers = int(self.inliers.sum())
        return improved


def _refit(best: _Best, estimator: Estimator, options: RansacOptions) -> None:
    for _ in range(options.refits):
        if best.model is None or best.inliers is None or best.num_inliers <= estimator.sample_size:
            return
        models, valid = estimator.refit(best.model, best.inliers)
        if not best.improve(estimator, models[valid], options.max_error):
            return


def _samples_needed(inlier_ratio: float, sample_size: int, options: RansacOptions) -> int:
    all_inliers = inlier_ratio**sample_size
    if all_inliers >= 1.0:
        return 0
    if all_inliers <= 0.0:
        return options.max_samples
    return math.ceil(math.log(1.0 - options.confidence) / math.log1p(-all_inliers))
