"""Bundle adjustment of what is registered and placed, and how well that determines the finished scene."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.bundle import (
    BundleOptions,
    BundleProblem,
    BundleReport,
    Term,
    Uncertainty,
    determinations,
    estimate_pixel_sigma,
    uncertainty,
    wished_changes,
)
from torchrefrac.bundle import adjust as adjust_bundle
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.observability import coefficients_as_stated
from torchrefrac.bundle.rows import OF_LAYERS
from torchrefrac.bundle.score import Given
from torchrefrac.bundle.terms import concerned_points
from torchrefrac.numerics import on_device, typical_deviation
from torchrefrac.optim import SingularError
from torchrefrac.recorder import Advance, Recorder
from torchrefrac.scene import Assessment, Interfaces, Scene, mean_deviation
from torchrefrac.sfm.outcome import Adjustment, Outcome
from torchrefrac.sfm.rules import Rules

GIVEN: tuple[Given, ...] = ("index_ratio", "focal")
EFFICIENT, CAREFUL = 2.0, 2.0
"""Times the noise: where the loss bends, and what weighs pixels against measurements, because errors of keypoints of
one track are not quite independent."""
OUTLYING = 4.0
"""Standard deviations of a component that one right observation in 3000 errs by."""
FINEST = 0.02
"""Pixels; no keypoint is known better."""
ENOUGH = 1e-6
"""Relative decrease of the cost at which an adjustment ends that others went before, or that is of many images: what it
falls by from there on moves single points that hardly fit, and cameras by hundredths of their standard deviations."""

OnStep = Callable[[int, float, float], None]


class Journal:
    """Reports the adjustments of one reconstruction to a recorder: their steps, and what they lead to."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._steps, self._shown = count(), count()

    def step(self, iteration: int, cost: float, damping: float) -> None:
        """One step of one of them."""
        step = next(self._steps)
        self._recorder.scalar("adjustment/cost", cost, step)
        self._recorder.scalar("adjustment/damping", damping, step)

    def show(self, name: str, scene: Scene, ids: Int[Tensor, " k"], most: int | None = None) -> None:
        """Residuals and the points `ids` (of which at most this many), where anyone wants to see them."""
        if not self._recorder.wants_pictures:
            return
        step = next(self._shown)
        self._recorder.histogram("residuals/px", scene.errors()[scene.accepted], step)
        ids = ids[:: 1 if most is None else max(-(-len(ids) // most), 1)]
        self._recorder.cloud(name, scene.points[ids], scene.colors[ids], step)


class Steps:
    """Passes the steps of one adjustment on and moves a meter, in which it takes up `most` steps."""

    def __init__(self, on_step: OnStep, most: int, advance: Advance) -> None:
        self._on_step, self._left, self._advance = on_step, most, advance
        self._last = 0

    def __call__(self, iteration: int, cost: float, damping: float) -> None:
        self._on_step(iteration, cost, damping)
        self._move(iteration - self._last, f"cost {cost:.4g}")
        self._last = iteration

    def end(self) -> None:
        """There will be no more steps, however many there were."""
        self._move(self._left, "")

    def _move(self, count: int, text: str) -> None:
        self._left -= count
        self._advance(count, text)


def adjust(scene: Scene, rules: Rules, on_step: OnStep | None = None) -> tuple[Scene, Outcome]:
    """Adjust all registered views and all points that observations support, and whatever rules.bundle.refine names."""
    part = scene.part()
    there, terms = rules.to_adjust(part)
    registered = there.views.registered
    report = adjust_bundle(
        there,
        rules.bundle,
        terms=terms,
        fixed=registered[:, None].expand(-1, 6) if rules.fixed_poses else None,
        check=False,
        callback=on_step,
    )
    return scene.with_part(part, on_device(report.scene, scene.points.device)), _outcome(report)


def adjust_locally(
    scene: Scene, rules: Rules, views: Bool[Tensor, " m"], on_step: OnStep | None = None
) -> tuple[Scene, Outcome]:
    """Adjust those registered `views` and the points that they support; other views, cameras and interfaces stay as
    they are."""
    part = scene.part(of=scene.supported_by(views))
    there, terms = rules.to_adjust(part)
    report = adjust_bundle(
        replace(there, cameras=there.cameras.exact(), interfaces=replace(there.interfaces, sigmas={})),
        replace(rules.bundle, refine=()),
        terms=terms,
        fixed=~on_device(views[part.view, None], there.points.device).expand(-1, 6),
        check=False,
        callback=on_step,
    )
    changed = on_device(report.scene, scene.points.device)
    changed = replace(changed, cameras=scene.cameras, interfaces=scene.interfaces)
    return scene.with_part(part, changed), _outcome(report)


def _outcome(report: BundleReport) -> Outcome:
    return Outcome(Adjustment.CONVERGED if report.status == "converged" else Adjustment.STOPPED, report=report)


def with_neighbours(scene: Scene, views: Bool[Tensor, " m"], least: int) -> Bool[Tensor, " m"]:
    """Registered `views`, and as many others, or `least`, that support most of the same points."""
    seen = scene.observations
    rows = scene.accepted & scene.supported_by(views)[seen.point]
    shared = torch.bincount(seen.view[rows], minlength=len(views)).masked_fill(views, 0)
    best = shared.topk(min(max(int(views.sum()), least), len(views)))
    return views.index_fill(0, best.indices[best.values > 0], True)


def with_height(bundle: BundleOptions) -> BundleOptions:
    """With the height of the water free, which positions and stated levels fix in their frame."""
    return replace(bundle, refine=tuple(dict.fromkeys((*bundle.refine, "plane_height"))))


def with_slope(bundle: BundleOptions) -> BundleOptions:
    """With its height and its tilt free, which levels stated of several places fix."""
    return replace(bundle, refine=tuple(dict.fromkeys((*with_height(bundle).refine, "plane_tilt"))))


def with_noise_found(bundle: BundleOptions, report: BundleReport) -> BundleOptions:
    """Options for another adjustment, which knows the noise of keypoints from one before it: at most what is expected.

    Weights are right only so: a noise that is taken to be larger than it is leaves too much weight to gravity and
    positions, and a loss that bends late lets poor matches weigh as much as good ones. The scale of the loss is that
    at which Huber's estimator has 95 % efficiency on Gaussian noise of two coordinates, of as much as the median error
    shows.
    """
    square = report.problem.squared_errors(report.scene)
    if not len(square):
        return bundle
    typical = typical_deviation(square.sqrt())
    sigma = estimate_pixel_sigma(report.problem, report.scene)
    return replace(
        ending_early(bundle),
        loss_scale=min(bundle.loss_scale, max(EFFICIENT * typical, FINEST)),
        pixel_sigma=min(bundle.pixel_sigma, max(CAREFUL * sigma, FINEST)),
    )


def ending_early(bundle: BundleOptions, tolerance: float = ENOUGH) -> BundleOptions:
    """Options for an adjustment that ends when the cost falls by this much of it at most."""
    solver = bundle.solver
    return replace(bundle, solver=replace(solver, function_tolerance=max(solver.function_tolerance, tolerance)))


def with_errors_found(rules: Rules, report: BundleReport, least: float | None) -> Rules:
    """Rules for what comes after an adjustment that shows how large errors are: observations may err by as many
    deviations as next to no right one does, but by no less than `least` pixels (None: as now) and no more than now."""
    length = report.problem.squared_errors(report.scene).sqrt()
    if least is None or not len(length):
        return rules
    return replace(rules, max_error=min(rules.max_error, max(OUTLYING * typical_deviation(length), least)))


def assess_scene(scene: Scene, rules: Rules, fixed: dict[str, str]) -> Assessment:
    """How well everything is determined; fixed: what an adjustment refused to refine. Empty where nothing is known."""
    part = scene.part()
    if not len(part.scene.observations):
        return Assessment()
    there, terms = rules.to_adjust(part)
    return on_device(assess(_problem(there, terms, rules, fixed), there, fixed), scene.points.device)


def common_tilt(scene: Scene, rules: Rules, fixed: dict[str, str]) -> Float[Tensor, " m"]:
    """How far errors that observations have in common make verticals uncertain, radians; zero where nothing is
    known."""
    part = scene.part()
    tilt = torch.zeros_like(scene.views.center[:, 0])
    if not len(part.scene.observations):
        return tilt
    there, terms = rules.to_adjust(part)
    try:
        known = uncertainty(_problem(there, terms, rules, fixed), there)
    except SingularError:
        return tilt
    if known.common is not None:
        tilt[part.view] = known.common.tilt(len(part.view)).to(tilt.device)
    return tilt


def _of_levels(known: Uncertainty) -> Float[Tensor, "e e"]:
    """Covariance of the heights of the interfaces, none of which tilts."""
    columns = known.layout.plane_columns(known.layout.interfaces)[:, 2]
    return known.reduced[columns[:, None], columns]


def _of_planes(known: Uncertainty, surfaces: Interfaces) -> Float[Tensor, "e e 3 3"]:
    """Covariances of the interfaces as z = h + s . (x, y): of h and s. An interface tilts about two tangents, by which
    its normal n changes, and its offset d does not: h = d / n_z, s = -n_xy / n_z."""
    columns, normal = known.layout.plane_columns(known.layout.interfaces), surfaces.normal
    first, second = surfaces.planes.tangents_like(normal)
    turns = torch.stack((-second, first, torch.zeros_like(first)), dim=-1)
    rises = normal.new_tensor((0.0, 0.0, 1.0)).expand(len(normal), 1, 3)
    plane = torch.cat((surfaces.offset[:, None], -normal[:, :2]), dim=1)
    by = torch.cat((rises, -turns[:, :2]), dim=1) - plane[..., None] * turns[:, 2:] / normal[:, 2:, None]
    by = by / normal[:, 2:, None]
    covariance = known.reduced[columns[:, None, :, None], columns[None, :, None]]
    return by[:, None] @ covariance @ by[None].mT


def _problem(scene: Scene, terms: Sequence[Term], rules: Rules, fixed: dict[str, str]) -> BundleProblem:
    """That of adjusting a scene all of which takes part, without what an adjustment refused to refine."""
    refine = tuple(name for name in rules.bundle.refine if name not in fixed)
    layout = Layout.create(scene, refine, reduced=concerned_points(terms, scene.points))
    return BundleProblem.create(scene, layout, rules.bundle, terms)


def assess(problem: BundleProblem, scene: Scene, fixed: dict[str, str]) -> Assessment:
    """At the minimum `scene`; fixed: what was not refined, and why. Where the data do not determine even the cameras
    nothing is said but what was fixed."""
    try:
        known = uncertainty(problem, scene)
        found = determinations(problem, scene, known.growth * known.pixel_sigma) if scene.index_ratio > 1.0 else []
    except SingularError:
        return Assessment(fixed=fixed)
    fixed = fixed | coefficients_as_stated(problem.layout, scene.cameras)
    centers = known.pose[:, 3:, 3:]
    levels = _of_levels(known) if "plane_height" in problem.layout.water else None
    planes = None
    if levels is not None and "plane_tilt" in problem.layout.water:
        planes = _of_planes(known, scene.interfaces)
        middle = torch.nn.functional.pad(scene.middle[:2], (1, 0), value=1.0)
        levels = torch.einsum("i,efij,j->ef", middle, planes, middle)
    tilts = [each.posterior for each in found if each.name == "plane_tilt" and "plane_tilt" in problem.layout.water]
    wished = [wished_changes(problem, scene, name, known.pixel_sigma).items() for name in GIVEN]
    if scene.interfaces.may_have_glass:
        glazed = replace(scene, interfaces=scene.interfaces.with_glass())
        wished.append(wished_changes(problem, glazed, "layer_thickness", known.pixel_sigma).items())
    return Assessment(
        pixel_sigma=known.pixel_sigma,
        point_covariance=known.points,
        relative_covariance=known.relative,
        center_sigma=mean_deviation(centers),
        center_covariance=centers,
        index_ratio_sigma=float(known.index_ratio) if "index_ratio" in problem.layout.water else None,
        layer_sigma={name: known.medium_sigma(name) for name in OF_LAYERS if name in problem.layout.water},
        intrinsics_sigma=known.intrinsics,
        determined=tuple(d.sentence for d in found),
        fixed=fixed,
        wished={name: (by, known.growth * sigma) for each in wished for name, (by, sigma) in each} if found else {},
        surface_slope=0.0 if known.common is None else known.common.slope,
        surface_moves=known.common is not None and known.common.moving_slope > known.common.still_slope,
        common_tilt=None if known.common is None else known.common.tilt(len(scene.views)),
        growth=known.growth,
        level_covariance=levels,
        plane_covariance=None if planes is None else planes.diagonal(dim1=0, dim2=1).movedim(-1, 0),
        tilt_sigma=math.radians(tilts[0]) if tilts else None,
    )
