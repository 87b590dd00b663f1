"""The bundle adjustment cost (paper, Eq. 20): reprojection errors through the water, and whatever else was measured."""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchrefrac.bundle.gauge import count_gauge, gauge_directions, similarity_motions
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.rows import RowModel, observation_rows
from torchrefrac.bundle.state import BundleState, Observations
from torchrefrac.bundle.terms import GlobalPrior, Term
from torchrefrac.numerics import morton_code
from torchrefrac.optim import REDUCED_SIZE, Blocks, Linearized, SchurPlan, Step, linearize


@dataclass(frozen=True)
class BundleProblem:
    """Observations of points that are eliminated (`seen`, in the plan's order) and of points that are kept.

    gauge: how many directions nothing fixes. spare: rows of linearisations that are gone, to be written to again.
    """

    plan: SchurPlan
    layout: Layout
    seen: Observations
    kept_seen: Observations
    terms: tuple[Term, ...]
    options: BundleOptions
    gauge: int
    spare: list[Tensor] = field(default_factory=list, repr=False, compare=False)

    @classmethod
    def create(
        cls,
        state: BundleState,
        layout: Layout,
        observations: Observations,
        options: BundleOptions,
        terms: Sequence[Term] = (),
    ) -> "BundleProblem":
        """The problem of adjusting `state`. The layout says what varies, the terms what was measured besides pixels."""
        if layout.kept is None:
            seen, kept_seen, id_of = observations, observations[:0], None
        else:
            among = layout.kept[observations.point]
            seen, kept_seen = observations[~among], observations[among]
            id_of = torch.cumsum((~layout.kept).long(), dim=0) - 1
        free = state.points[layout.free_points]
        point = seen.point if id_of is None else id_of[seen.point]
        sizes = layout.num_cameras, len(free), layout.families, 3 * layout.num_kept
        try:
            plan = SchurPlan.create(seen.camera, point, *sizes, locality=morton_code(free))
        except ValueError as error:
            raise ValueError("a camera sees a point twice; each pair of camera and point may occur once") from error
        expected = (
            GlobalPrior(name, state, sigma)
            for name in (*layout.lens, *layout.water)
            if (sigma := options.expected.sigma_of(name)) is not None
        )
        terms = (*terms, *expected)
        return cls(plan, layout, seen[plan.order], kept_seen, terms, options, _gauge(state, layout, terms))

    @property
    def rows_of(self) -> RowModel:
        options = self.options
        return RowModel(
            self.layout.lens,
            self.layout.water,
            options.loss,
            options.loss_scale,
            frozen_ratio=options.jacobian == "frozen_ratio",
        )

    def linearize(self, state: BundleState) -> Linearized:
        """The normal equations at `state`, with their gauge."""
        options, layout = self.options, self.layout
        rows, cost = self._rows(state, self.seen, self.spare.pop() if self.spare else None)
        residuals = [term.residuals(state, layout) for term in self.terms]
        blocks = []
        for value, jacobian, columns in residuals:
            cost = cost + 0.5 * options.pixel_sigma**2 * value.square().sum()
            blocks.append(Blocks.of_rows(columns, options.pixel_sigma * jacobian, options.pixel_sigma * value))
        if len(self.kept_seen):
            kept_rows, kept_cost = self._rows(state, self.kept_seen)
            columns = torch.cat(
                (self.plan.columns[self.kept_seen.camera], layout.point_columns(self.kept_seen.point)), dim=1
            )
            by_observation = kept_rows.permute(2, 0, 1)
            blocks.append(Blocks.of_rows(columns, by_observation[..., :-1], by_observation[..., -1]))
            cost = cost + kept_cost
        cost = torch.where(state.index_ratio >= 1.0, cost, torch.inf)
        gauge = gauge_directions(state, layout, residuals, self.gauge)
        system = linearize(self.plan, rows, cost, blocks, gauge)
        weakref.finalize(system, self.spare.append, rows)  # new memory costs as much as what is written to it
        linearized = Linearized(system, options.reduced_solver, options.iterative)
        if linearized.is_dense:
            return linearized
        return replace(linearized, coarse=similarity_motions(state, layout)[0])

    def detached(self) -> "BundleProblem":
        """The same without a graph in the observations."""
        return replace(self, seen=self.seen.detached(), kept_seen=self.kept_seen.detached())

    def with_layout(
        self, state: BundleState, layout: Layout, options: BundleOptions, terms: Sequence[Term]
    ) -> "BundleProblem":
        """The same observations with something else varying of lens and water."""
        plan, gauge = self.plan.with_families(layout.families), _gauge(state, layout, terms)
        return replace(self, plan=plan, layout=layout, options=options, terms=tuple(terms), gauge=gauge)

    def squared_errors(self, state: BundleState) -> Tensor:
        """Squared reprojection errors (N) of the possible observations, square pixels."""
        every = [
            observation_rows(replace(self.rows_of, loss="squared"), state, self.layout.links, seen)[0][:, -1]
            for seen in (self.seen, self.kept_seen)
        ]
        square = torch.cat(every, dim=-1).square().sum(dim=0)
        return square[square > 0.0]

    @property
    def unknowns_per_residual(self) -> float:
        """Free unknowns over numbers measured."""
        layout = self.layout
        unknowns = layout.size - REDUCED_SIZE * layout.num_cameras if layout.held is not None else layout.size
        if layout.held is not None:
            unknowns += int((~layout.held).sum())
        if not layout.hold_points:
            unknowns += 3 * (layout.num_points - layout.num_kept)
        return unknowns / max(2 * (len(self.seen) + len(self.kept_seen)), 1)

    def retract(self, state: BundleState, step: Step) -> BundleState:
        return self.layout.retract(state, step)

    def _rows(self, state: BundleState, seen: Observations, out: Tensor | None = None) -> tuple[Tensor, Tensor]:
        rows, cost = observation_rows(self.rows_of, state, self.layout.links, seen, self.options.compiled, out)
        if self.layout.held is not None:
            rows[:, self.plan.layout.block].mul_((~self.layout.held)[seen.camera].T)
        if self.layout.hold_points:
            rows[:, self.plan.layout.eliminated] = 0.0
        return rows, cost


def _gauge(state: BundleState, layout: Layout, terms: Sequence[Term]) -> int:
    """How many directions of the gauge nothing fixes."""
    if layout.hold_points:
        return 0
    return count_gauge(state, layout, [term.residuals(state, layout) for term in terms])
