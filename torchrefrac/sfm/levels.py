"""Whether all views look through water that stands at one level, as photographs of two days do not.

The score test (see `bundle.score`), of all views at once: every view gets a surface of its own, and one Gauss-Newton
step from the minimum with one surface says by how much each would stand higher. Index ratio and focal length vary too,
because they move the levels of views at different heights.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.bundle import BundleProblem, adjust
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.score import Given, columns_of
from torchrefrac.optim import Covariance, SingularError
from torchrefrac.scene import Assessment, Part, Scene
from torchrefrac.sfm.rules import Rules

FEWEST_VIEWS, FEWEST_OTHERS = 4, 2
APART = 4.0
"""Difference of two levels, in root mean squares of what the views of each scatter about it."""
SURE = 5.0
"""The same in its own standard deviations, which errors of the model make look too small."""
NOTABLE = 0.01
"""The same in mean heights of the cameras."""


def with_levels(assessment: Assessment, scene: Scene, rules: Rules, fixed: Mapping[str, str]) -> Assessment:
    """The assessment of a scene, with `levels` where its views ask for two, and with what they wish of index ratio and
    focal length then. fixed: what an adjustment refused to refine."""
    part = scene.part()
    m, sigma = len(part.view), assessment.pixel_sigma
    if m < FEWEST_VIEWS or sigma is None or len(scene.interfaces) > 1 or not scene.interfaces.stand_in_world:
        return assessment
    each = with_surfaces(part.scene, torch.arange(m))
    of_all = {"plane_tilt", *fixed}
    refined = (name for name in rules.bundle.refine if name not in of_all)
    layout = Layout.create(each, tuple(dict.fromkeys((*refined, "plane_height", "index_ratio", "focal"))))
    problem = BundleProblem.create(each, layout, replace(rules.bundle, pixel_sigma=sigma), rules.measurements(part))
    linearized = problem.linearize(each)
    columns = layout.plane_columns(layout.interfaces)[:, 2]
    try:
        step = linearized.solve(0.0).reduced
        higher, others = step[columns], smaller_group(step[columns])
        difference = higher[others].mean() - higher[~others].mean()
        if not _are_apart(higher, others, difference, part.scene.views.center[:, 2].mean()):
            return assessment
        covariance = Covariance.of(linearized.system).among.times((assessment.growth * sigma) ** 2)
    except SingularError:
        return assessment
    contrast = torch.where(others, 1.0 / others.sum(), -1.0 / (~others).sum()).to(step)
    deviation = (contrast @ covariance[columns[:, None], columns] @ contrast).clamp(min=0.0).sqrt()
    if bool(difference.abs() <= SURE * deviation):
        return assessment
    given: tuple[Given, ...] = ("index_ratio", "focal")
    columns_by_name = (columns_of(each, layout, name) for name in given)
    asked = {key: column for of in columns_by_name for key, column in of.items() if key in assessment.wished}
    every = torch.arange(layout.size)
    variance = covariance[every, every].clamp(min=0.0)
    wished = {name: (float(step[column]), float(variance[column].sqrt())) for name, column in asked.items()}
    difference = _adjusted_difference(part, others, rules)
    levels = torch.zeros(len(scene.views), dtype=step.dtype).index_put((part.view[others],), difference)
    return replace(assessment, levels=levels, wished=wished)


def smaller_group(values: Float[Tensor, " k"]) -> Bool[Tensor, " k"]:
    """Which values belong to the smaller of the two groups that leave the least sum of squares about their means."""
    order, k = values.argsort(), len(values)
    total, square, count = values[order].cumsum(0), values[order].square().cumsum(0), torch.arange(1, k + 1)
    left = square - total.square() / count
    right = (square[-1] - square) - (total[-1] - total).square() / (k - count).clamp(min=1)
    cut = int((left + right)[:-1].argmin()) + 1
    group = torch.zeros(k, dtype=torch.bool)
    group[order[:cut] if 2 * cut <= k else order[cut:]] = True
    return group


def _are_apart(
    higher: Float[Tensor, " k"], others: Bool[Tensor, " k"], difference: Float[Tensor, ""], height: Float[Tensor, ""]
) -> bool:
    """Whether two groups are worth a closer look: neither chance, nor views that merely scatter."""
    about = torch.where(others, higher[others].mean(), higher[~others].mean())
    scatter = (higher - about).square().mean().sqrt()
    far = difference.abs() > torch.maximum(APART * scatter, NOTABLE * height)
    return bool(far) and int(others.sum()) >= FEWEST_OTHERS


def _adjusted_difference(part: Part, others: Bool[Tensor, " k"], rules: Rules) -> Float[Tensor, ""]:
    """By how much higher the water stands for some views when everything is adjusted with two levels: one step of a
    test falls short of that."""
    two, bundle = with_surfaces(part.scene, others.long()), replace(rules.bundle, refine=("plane_height",))
    offset = adjust(two, bundle, terms=rules.measurements(part), check=False).scene.interfaces.offset
    return offset[1] - offset[0]


def with_surfaces(scene: Scene, interface: Int[Tensor, " m"]) -> Scene:
    """The scene with its one surface as many times as the views need it, which have those of these numbers."""
    surfaces = scene.interfaces.repeated(int(interface.max()) + 1)
    return replace(scene, interfaces=surfaces, views=replace(scene.views, interface=interface))
