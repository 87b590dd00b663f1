"""Adjust views and points together, or one view alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.bundle.inputs import check_inputs
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.observability import undetermined
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.terms import Term, concerned_points
from torchrefrac.optim import Status, minimize
from torchrefrac.scene import Scene


@dataclass(frozen=True)
class BundleReport:
    """The adjusted scene, why the search ended (see `optim.minimize`) and the cost after every accepted step.

    fixed: what was to be refined but was not, because the data do not determine it, and by how little they do.
    problem: what was minimised, for `uncertainty`.
    """

    scene: Scene
    status: Status
    iterations: int
    costs: list[float]
    problem: BundleProblem
    fixed: dict[str, str] = field(default_factory=dict)

    @property
    def stopped_after(self) -> int | None:
        """The iterations at whose limit the search ended; None where it found a minimum."""
        return self.iterations if self.status == "max_iterations" else None

    def summary(self) -> str:
        """How it went, in a line."""
        return f"cost {self.costs[0]:.6g} to {self.costs[-1]:.6g} in {self.iterations} iterations, {self.status}"


def adjust(
    scene: Scene,
    options: BundleOptions | None = None,
    *,
    terms: Sequence[Term] = (),
    fixed: Bool[Tensor, "m 6"] | None = None,
    fix_points: bool = False,
    check: bool = True,
    callback: Callable[[int, float, float], None] | None = None,
) -> BundleReport:
    """Minimise the reprojection error, and that of all `terms`, over all that varies (paper, section 3.5, and more).

    All views, points and observations of the scene take part, see `Scene.part`. terms: measurements besides pixels.
    fixed: unknowns of the poses (rotation, then centre) that stay as they are; fix_points: none of the points varies,
    as those of a board, which may then be seen by a single view. What else varies is in the options; all
    interfaces share one index ratio. A gauge that nothing fixes is free: the result is then as near to the start as the
    data allow (shifts along the water, heading, scale about it; at index ratio 1 all similarities).

    Unknowns in `options.refine` that the data do not determine are fixed unless `options.refine_unseen`, and the report
    names them. check: raise UnadjustableError or SceneError for what cannot be adjusted, see `check_inputs`; any
    failure after that is a status.
    """
    options = options or BundleOptions()
    reduced = concerned_points(terms, scene.points)
    if check:
        known = torch.ones_like(scene.placed) if fix_points else reduced
        check_inputs(scene, fixed, known, connected=not fix_points)
    layout = Layout.create(scene, options.refine, fixed, fix_points, reduced)
    problem = BundleProblem.create(scene, layout, options, terms)
    refused = {} if options.refine_unseen else undetermined(problem, scene, options.pixel_sigma)
    if refused:
        left = tuple(name for name in options.refine if name not in refused)
        layout = Layout.create(scene, left, fixed, fix_points, reduced)
        problem = problem.with_layout(scene, layout, options, problem.terms)  # no term is about what is refused
    report = minimize(problem, scene, options.solver, callback)
    problem.buffers.clear()
    return BundleReport(report.state, report.status, report.iterations, report.costs, problem, refused)


def adjust_pose(scene: Scene, options: BundleOptions | None = None, terms: Sequence[Term] = ()) -> BundleReport:
    """Minimise the reprojection error of the one view of a scene; points, camera and interface are fixed."""
    options, scene = replace(options or BundleOptions(), refine=()), replace(scene, cameras=scene.cameras.exact())
    problem = BundleProblem.create(scene, Layout.create(scene, fix_points=True), options, terms)
    report = minimize(problem, scene, options.solver)
    return BundleReport(report.state, report.status, report.iterations, report.costs, problem)
