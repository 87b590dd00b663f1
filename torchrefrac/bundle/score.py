"""What the images would change of something that was given, without adjusting it: the score test of statistics."""

from dataclasses import replace
from typing import Literal

from jaxtyping import Bool
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.rows import INTRINSICS, MEDIA, WATER
from torchrefrac.optim import GaussNewtonInverse, SingularError
from torchrefrac.scene import Scene

Given = Literal["index_ratio", "layer_thickness", "focal"]


def wished_changes(
    problem: BundleProblem, scene: Scene, name: Given, pixel_sigma: float
) -> dict[str, tuple[float, float]]:
    """One Gauss-Newton step of `name` (the index ratio, the thickness of the layer before the water, or the logarithm
    of the focal length) from the minimum `scene` of `problem`, in which it does not vary, everything else following;
    and its standard deviation. pixel_sigma: noise of a keypoint, pixels. Keys: `name`, or where there are several
    cameras `name` and which (see `Cameras.label`).

    Empty where it varies already, or nothing determines it. Near the minimum the step is where an adjustment with it
    would end (Rao's score test, 1948); far off it still has the right sign.
    """
    layout = problem.layout
    if name in (*layout.intrinsics, *layout.water) and name not in layout.fixed_intrinsics:
        return {}
    if name in MEDIA:
        layout = replace(layout, water=tuple(n for n in WATER if n in (name, *layout.water)))
    else:
        intrinsics = tuple(n for n in INTRINSICS if n in (name, *layout.intrinsics))
        fixed_intrinsics = {n: of for n, of in layout.fixed_intrinsics.items() if n != name}
        layout = replace(layout, intrinsics=intrinsics, fixed_intrinsics=fixed_intrinsics)
    options = replace(problem.options, pixel_sigma=pixel_sigma)
    asked = problem.with_layout(scene, layout, options, problem.terms)
    linearized = asked.linearize(scene)
    try:
        inverse = GaussNewtonInverse.of(linearized.system)
    except SingularError:
        return {}
    step = linearized.solve(0.0).reduced
    columns = columns_of(scene, layout, name, problem.layout.fixed_intrinsics.get(name))
    sigmas = pixel_sigma * inverse.deviations_of(list(columns.values()))
    return {
        key: (float(step[column]), float(sigma)) for (key, column), sigma in zip(columns.items(), sigmas, strict=True)
    }


def columns_of(scene: Scene, layout: Layout, name: Given, which: Bool[Tensor, "g 1"] | None = None) -> dict[str, int]:
    """Where the index ratio, or the focal lengths of the cameras that take part, stand among the reduced unknowns.
    which: of these cameras alone."""
    if name in MEDIA:
        return {name: layout.medium_column(name)}
    rows = layout.camera.unique()
    rows = rows if which is None else rows[which[rows, 0]]
    columns = layout.intrinsics_columns(name, rows)[:, 0].tolist()
    return {f"{name}{scene.cameras.label(row)}": column for row, column in zip(rows.tolist(), columns, strict=True)}
