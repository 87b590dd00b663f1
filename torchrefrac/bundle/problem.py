"""The bundle adjustment cost (paper, Eq. 20): reprojection errors through the water, and whatever else was measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.bundle.gauge import gauge_directions
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.rows import RowModel, observation_rows
from torchrefrac.bundle.state import BundleState, Observations
from torchrefrac.bundle.terms import GlobalPrior, Term
from torchrefrac.numerics import morton_code
from torchrefrac.optim import Blocks, Linearized, SchurPlan, Step, linearize


@dataclass(frozen=True)
class BundleProblem:
    """Observations of points that are eliminated (`seen`, in the plan's order) and of points that are kept."""

    plan: SchurPlan
    layout: Layout
    seen: Observations
    kept_seen: Observations
    terms: tuple[Term, ...]
    options: BundleOptions

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
        free = state.points if layout.kept is None else state.points[~layout.kept]
        plan = SchurPlan.create(
            seen.camera,
            seen.point if id_of is None else id_of[seen.point],
            layout.num_cameras,
            len(free),
            layout.families,
            3 * layout.num_kept,
            locality=morton_code(free),
        )
        expected = (
            GlobalPrior(name, state, sigma)
            for name in (*layout.lens, *layout.water)
            if (sigma := options.expected.sigma_of(name)) is not None
        )
        return cls(plan, layout, seen[plan.order], kept_seen, (*terms, *expected), options)

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
        rows, cost = self._rows(state, self.seen)
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
        gauge = None if layout.hold_points else gauge_directions(state, layout, residuals)
        system = linearize(self.plan, rows, cost, blocks, gauge)
        return Linearized(system, options.reduced_solver, options.iterative, coarse=None)

    def retract(self, state: BundleState, step: Step) -> BundleState:
        return self.layout.retract(state, step)

    def _rows(self, state: BundleState, seen: Observations) -> tuple[Tensor, Tensor]:
        rows, cost = observation_rows(self.rows_of, state, self.layout.links, seen, self.options.compiled)
        if self.layout.held is not None:
            rows[:, :6].mul_((~self.layout.held)[seen.camera].T)
        if self.layout.hold_points:
            rows[:, -4:-1] = 0.0
        return rows, cost
