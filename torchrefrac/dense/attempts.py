"""Patches that are being adjusted: Levenberg-Marquardt, where each accepts and rejects by itself.

All that are under way stand in one table. New ones join it and those that are done leave it after every pass over the
images, so that many are always worked on together and none waits for the slowest. A pass costs much the same for a
few, and a patch is judged by the pass that it ends with.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.dense.judge import Subjects, judge
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.photometric import Agreement, Comparison
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.window import Window
from torchrefrac.optim.batched import Quadratic, solve_damped, where_each

DAMPING = 1e-4
MIN_SCALE = 0.4  # of an image against the reference: one that shows the surface smaller than this is not compared


class Ended(NamedTuple):
    """Numbers of the attempts that have ended; the patches of those that are believed, and their numbers."""

    number: Int[Tensor, " n"]
    patches: Patches
    good: Int[Tensor, " k"]


@dataclass(frozen=True)
class Attempts:
    """n patches under way in one scope.

    number: what the caller knows them by; subjects: what is known of them; corners, reference, image, level and
    present: as in `Comparison`; model: cost and derivatives at states; step: the next to be tried, with its damping;
    passes: how many have been made; ending: whether the next one only looks at the states as they are.
    """

    number: Int[Tensor, " n"]
    subjects: Subjects
    corners: PixelRays
    reference: Float[Tensor, "n samples"]
    image: Int[Tensor, "n v"]
    level: Int[Tensor, "n v"]
    present: Bool[Tensor, "n v"]
    states: Float[Tensor, "n 3"]
    model: Quadratic
    step: Float[Tensor, "n 3"]
    damping: Float[Tensor, " n"]
    passes: Int[Tensor, " n"]
    ending: Bool[Tensor, " n"]

    @classmethod
    def begun(
        cls,
        number: Int[Tensor, " n"],
        subjects: Subjects,
        corners: PixelRays,
        reference: Float[Tensor, "n samples"],
        image: Int[Tensor, "n v"],
        present: Bool[Tensor, "n v"],
        states: Float[Tensor, "n 3"],
    ) -> "Attempts":
        """At states of which nothing is known yet."""
        nowhere, passes = torch.zeros_like(states), torch.zeros_like(number)
        unknown = Quadratic(nowhere[:, 0] + torch.inf, nowhere, nowhere[:, None].repeat(1, 3, 1))
        return cls(
            number=number,
            subjects=subjects,
            corners=corners,
            reference=reference,
            image=image,
            level=torch.zeros_like(image),
            present=present,
            states=states,
            model=unknown,
            step=nowhere,
            damping=nowhere[:, 0] + DAMPING,
            passes=passes,
            ending=passes > 0,
        )

    @classmethod
    def together(cls, parts: Sequence["Attempts"]) -> "Attempts":
        """One table of several."""
        return cls(*(joined([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __len__(self) -> int:
        return len(self.number)

    def __getitem__(self, rows: Int[Tensor, " k"] | slice) -> "Attempts":
        """Some of them."""
        return Attempts(*(rows_of(getattr(self, f.name), rows) for f in fields(self)))

    def advance(self, scope: Scope, options: DenseOptions) -> tuple["Attempts", Ended]:
        """After one more pass over the images: those that go on, and those that have ended."""
        comparison = self.comparison(scope, options)
        seen = comparison.project(self.states + self.step)
        comparison = comparison.at_matching_levels(seen, self.passes == 0, MIN_SCALE)
        agreement = comparison.agreement(seen)
        tried = comparison.model(agreement)
        moved = self.step.any(dim=-1) | (self.passes == 0)
        better = (moved & (tried.cost <= self.model.cost)) | self.ending
        states = torch.where(better[:, None], self.states + self.step, self.states)
        model = where_each(better, tried, self.model)
        damping = torch.where(better, 0.1, 10.0) * self.damping
        step = solve_damped(model, damping)
        reach = torch.where(agreement.usable, agreement.motion, 0.0).amax(dim=1) * step.abs().amax(dim=1)
        small = (reach < options.last_step) & (step.any(dim=-1) | ~model.gradient.any(dim=-1))
        exhausted = self.passes >= options.iterations
        last = small | exhausted | self.ending
        taken = ~last | (small & better & ~exhausted & ~self.ending)
        step = torch.where(taken[:, None], step, 0.0)
        changes = {"level": comparison.level, "present": comparison.present, "states": states, "model": model}
        passes = self.passes + 1
        after = replace(self, **changes, step=step, damping=damping, passes=passes, ending=last)
        done = (better & last).nonzero()[:, 0]
        return after[(~(better & last)).nonzero()[:, 0]], after[done]._judged(rows_of(agreement, done), scope, options)

    def comparison(self, scope: Scope, options: DenseOptions) -> Comparison:
        """With the images of the scope."""
        return Comparison(
            atlas=scope.atlas,
            window=Window.across(options.window),
            cameras=scope.cameras,
            rays=self.corners,
            reference=self.reference,
            image=self.image,
            level=self.level,
            present=self.present,
            tau=options.loss_scale,
        )

    def _judged(self, agreement: Agreement, scope: Scope, options: DenseOptions) -> Ended:
        """By the last pass; where the last step leads nobody has looked."""
        comparison = self.comparison(scope, options)
        patches, good = judge(scope, self.subjects, comparison, agreement, self.states + self.step, options)
        return Ended(self.number, patches, self.number[good])


def rows_of(table: Any, rows: Int[Tensor, " k"] | slice) -> Any:
    """Of a tensor or rays, or of each in a tuple of tables."""
    if isinstance(table, (Tensor, PixelRays)):
        return table[rows]
    return type(table)(*(rows_of(part, rows) for part in table))


def joined(tables: Sequence[Any]) -> Any:
    """Tensors or rays, or tuples of tables, one below the other."""
    if isinstance(tables[0], Tensor):
        return torch.cat(list(tables))
    if isinstance(tables[0], PixelRays):
        return PixelRays.together(tables)
    return type(tables[0])(*(joined(parts) for parts in zip(*tables, strict=True)))
