"""Bundle adjustment of what is registered and placed, and what it says about the finished scene."""

from collections.abc import Callable

import torch

from torchrefrac.bundle import BundleOptions, BundleProblem
from torchrefrac.bundle import adjust as adjust_bundle
from torchrefrac.bundle.layout import Layout
from torchrefrac.recorder import Advance
from torchrefrac.scene import Assessment, Scene
from torchrefrac.sfm.assessment import assess
from torchrefrac.sfm.outcome import Adjustment, Outcome
from torchrefrac.sfm.rules import Rules

OnStep = Callable[[int, float, float], None]


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
    report = adjust_bundle(
        part.scene,
        rules.bundle,
        terms=rules.measurements(part),
        fixed=torch.ones(len(part.view), 6, dtype=torch.bool) if rules.fixed_poses else None,
        check=False,
        callback=on_step,
    )
    kind = Adjustment.CONVERGED if report.status == "converged" else Adjustment.STOPPED
    return scene.with_part(part, report.scene), Outcome(kind, report=report)


def assess_scene(scene: Scene, rules: Rules, fixed: dict[str, str]) -> Assessment:
    """How well everything is determined; fixed: what an adjustment refused to refine. Empty where nothing is known."""
    part = scene.part()
    if not len(part.scene.observations):
        return Assessment()
    options: BundleOptions = rules.bundle
    layout = Layout.create(part.scene, tuple(name for name in options.refine if name not in fixed))
    problem = BundleProblem.create(part.scene, layout, options, rules.measurements(part))
    return assess(problem, part.scene, fixed)
