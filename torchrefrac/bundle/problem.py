"""The bundle adjustment cost (paper, Eq. 20): reprojection errors through the water, and whatever else was measured."""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.bundle.gauge import count_gauge, gauge_directions, similarity_motions
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.rows import RowModel, observation_rows
from torchrefrac.bundle.terms import Term, expectations
from torchrefrac.numerics import morton_code
from torchrefrac.optim import REDUCED_SIZE, Blocks, Linearized, SchurPlan, Step, linearize
from torchrefrac.scene import Observations, Scene


@dataclass(frozen=True)
class BundleProblem:
    """Observations of points that are eliminated (`seen`, in the plan's order) and of points that are reduced unknowns.

    gauge: how many directions nothing fixes. buffers: rows of linearisations that are gone, to be written to again.
    """

    plan: SchurPlan
    layout: Layout
    seen: Observations
    seen_reduced: Observations
    terms: tuple[Term, ...]
    options: BundleOptions
    gauge: int
    buffers: list[Float[Tensor, "2 row k"]] = field(default_factory=list, repr=False, compare=False)

    @classmethod
    def create(
        cls, scene: Scene, layout: Layout, options: BundleOptions, terms: Sequence[Term] = ()
    ) -> "BundleProblem":
        """The problem of adjusting `scene`. The layout says what varies, the terms what was measured besides pixels.

        Raises ValueError where a view sees a point twice.
        """
        seen = scene.observations
        if layout.reduced is None:
            seen_reduced, point = seen[:0], seen.point
        else:
            among = layout.reduced[seen.point]
            seen, seen_reduced = seen[~among], seen[among]
            point = (torch.cumsum((~layout.reduced).long(), dim=0) - 1)[seen.point]
        free = scene.points[layout.eliminated_points]
        sizes = layout.num_views, len(free), layout.families, 3 * len(layout.reduced_points)
        try:
            plan = SchurPlan.create(seen.view, point, *sizes, locality=morton_code(free))
        except ValueError as error:
            raise ValueError("a view sees a point twice; each pair of view and point may occur once") from error
        terms = (*terms, *expectations(scene, layout, options.expected))
        return cls(plan, layout, seen[plan.order], seen_reduced, terms, options, _gauge(scene, layout, terms))

    @property
    def rows_of(self) -> RowModel:
        """What the rows of the Jacobian depend on besides the scene."""
        options, frozen = self.options, self.options.jacobian == "frozen_ratio"
        varying = self.layout.intrinsics, self.layout.water
        return RowModel(*varying, options.loss, options.loss_scale, frozen, self.layout.moves_with_camera)

    def linearize(self, state: Scene, near: bool = False) -> Linearized:
        """The normal equations at a scene, with their gauge. near: a minimum, where steps may be as long as the second
        derivatives of the loss allow."""
        scene, options, layout = state, self.options, self.layout
        rows, cost = self._rows(scene, self.seen, near, self.buffers.pop() if self.buffers else None)
        residuals = [term.residuals(scene, layout) for term in self.terms]
        blocks = []
        for value, jacobian, columns in residuals:
            cost = cost + 0.5 * options.pixel_sigma**2 * value.square().sum()
            blocks.append(Blocks.of_rows(columns, options.pixel_sigma * jacobian, options.pixel_sigma * value))
        if len(self.seen_reduced):
            more_rows, more_cost = self._rows(scene, self.seen_reduced, near)
            columns = (self.plan.columns[self.seen_reduced.view], layout.point_columns(self.seen_reduced.point))
            by_observation = more_rows.permute(2, 0, 1)
            blocks.append(Blocks.of_rows(torch.cat(columns, dim=1), by_observation[..., :-1], by_observation[..., -1]))
            cost = cost + more_cost
        cost = torch.where(scene.interfaces.are_possible, cost, torch.inf)
        gauge = gauge_directions(scene, layout, residuals, self.gauge)
        system = linearize(self.plan, rows, cost, blocks, gauge)
        weakref.finalize(system, self.buffers.append, rows)  # new memory costs as much as what is written to it
        linearized = Linearized(system, options.reduced_solver, options.iterative)
        if linearized.method.name != "iterative":
            return linearized
        return replace(linearized, solver="iterative", coarse=similarity_motions(scene, layout)[0])

    def detached(self) -> "BundleProblem":
        """The same without a graph in the observations."""
        return replace(self, seen=self.seen.detached(), seen_reduced=self.seen_reduced.detached())

    def with_layout(
        self, scene: Scene, layout: Layout, options: BundleOptions, terms: Sequence[Term]
    ) -> "BundleProblem":
        """The same observations with something else varying of intrinsics and water."""
        plan, gauge = self.plan.with_families(layout.families), _gauge(scene, layout, terms)
        return replace(self, plan=plan, layout=layout, options=options, terms=tuple(terms), gauge=gauge)

    def squared_errors(self, scene: Scene) -> Float[Tensor, " possible"]:
        """Squared reprojection errors over their noise of the possible observations, square pixels."""
        square = torch.cat([self.errors(scene, seen).square().sum(dim=0) for seen in (self.seen, self.seen_reduced)])
        return square[square > 0.0]

    def errors(self, scene: Scene, seen: Observations) -> Float[Tensor, "2 k"]:
        """Projections minus pixels over their noise of some of the observations, by the root of their weights, zero
        where impossible."""
        return observation_rows(replace(self.rows_of, loss="squared"), scene, seen)[0][:, -1]

    @property
    def unknowns_per_residual(self) -> float:
        """Free unknowns over numbers measured."""
        unknowns = self.reduced_unknowns
        if not self.layout.fix_points:
            unknowns += 3 * len(self.layout.eliminated_points)
        return unknowns / max(2 * (len(self.seen) + len(self.seen_reduced)), 1)

    @property
    def reduced_unknowns(self) -> int:
        """How many reduced unknowns are free."""
        layout = self.layout
        poses = 0 if layout.fixed is None else int((~layout.fixed).sum()) - REDUCED_SIZE * layout.num_views
        return layout.size + poses - sum(int(fixed.sum()) for fixed in layout.fixed_intrinsics.values())

    def retract(self, state: Scene, step: Step) -> Scene:
        """The scene after a step."""
        return self.layout.retract(state, step)

    def _rows(
        self, scene: Scene, seen: Observations, near: bool, out: Float[Tensor, "..."] | None = None
    ) -> tuple[Float[Tensor, "2 row k"], Float[Tensor, ""]]:
        model = replace(self.rows_of, turned=near)
        rows, cost = observation_rows(model, scene, seen, self.options.compiled, out)
        if (constant := self.layout.constant) is not None:
            rows[:, self.plan.layout.reduced].mul_((~constant)[seen.view].T)
        if self.layout.fix_points:
            rows[:, self.plan.layout.eliminated] = 0.0
        return rows, cost


def _gauge(scene: Scene, layout: Layout, terms: Sequence[Term]) -> int:
    """How many directions of the gauge nothing fixes."""
    if layout.fix_points:
        return 0
    return count_gauge(scene, layout, [term.residuals(scene, layout) for term in terms])
