"""What the images would change of something that was given, without adjusting it: the score test of statistics."""

from dataclasses import replace
from typing import Literal

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.rows import INTRINSICS, WATER_WIDTH
from torchrefrac.optim import Covariance, SingularError
from torchrefrac.scene import Scene

Given = Literal["index_ratio", "focal"]


def wished_change(problem: BundleProblem, scene: Scene, name: Given, pixel_sigma: float) -> tuple[float, float] | None:
    """One Gauss-Newton step of `name` (the index ratio, or the logarithm of the focal length) from the minimum `scene`
    of `problem`, in which it does not vary, everything else following; and its standard deviation.

    None where it varies already, or nothing determines it. Near the minimum the step is where an adjustment with it
    would end (Rao's score test, 1948); far off it still has the right sign.
    """
    layout = problem.layout
    if name in (*layout.intrinsics, *layout.water):
        return None
    if name == "index_ratio":
        layout = replace(layout, water=tuple(n for n in WATER_WIDTH if n in (name, *layout.water)))
    else:
        layout = replace(layout, intrinsics=tuple(n for n in INTRINSICS if n in (name, *layout.intrinsics)))
    options = replace(problem.options, pixel_sigma=pixel_sigma)
    asked = problem.with_layout(scene, layout, options, problem.terms)
    linearized = asked.linearize(scene)
    try:
        covariance = Covariance.of(linearized.system)
    except SingularError:
        return None
    column = column_of(layout, name)
    step, variance = linearized.solve(0.0).reduced[column], covariance.reduced[column, column]
    return float(step), pixel_sigma * float(variance.clamp(min=0.0).sqrt())


def column_of(layout: Layout, name: Given) -> int:
    """Where the index ratio, or the focal length of the first camera, stands among the reduced unknowns."""
    if name == "index_ratio":
        return layout.index_column()
    return int(layout.intrinsics_columns(name, layout.cameras[:1])[0, 0])
