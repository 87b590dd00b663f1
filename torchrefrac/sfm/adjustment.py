"""Bundle adjustment of the growing model, and what it says about the finished one."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.bundle import (
    BundleOptions,
    BundleProblem,
    BundleReport,
    BundleState,
    GravityPrior,
    Links,
    Observations,
    Term,
    adjust,
)
from torchrefrac.bundle.layout import Layout
from torchrefrac.recorder import Advance
from torchrefrac.scene import Assessment, Capture
from torchrefrac.sfm.assessment import assess
from torchrefrac.sfm.model import SparseModel

Heard = Callable[[int, float, float], None]


class Steps:
    """Hears of the steps of one adjustment, passes them on, and moves a meter, in which it takes up `most` steps."""

    def __init__(self, heard: Heard, most: int, advance: Advance) -> None:
        self._heard, self._left, self._advance = heard, most, advance
        self._last = 0

    def __call__(self, iteration: int, cost: float, damping: float) -> None:
        self._heard(iteration, cost, damping)
        self._move(iteration - self._last, f"cost {cost:.4g}")
        self._last = iteration

    def end(self) -> None:
        """There will be no more steps, however many there were."""
        self._move(self._left, "")

    def _move(self, count: int, text: str) -> None:
        self._left -= count
        self._advance(count, text)


@dataclass(frozen=True)
class _Part:
    """The registered images and the points that they support, as an adjustment takes them."""

    images: Tensor
    ids: Tensor
    state: BundleState
    observations: Observations
    terms: list[Term]

    @classmethod
    def of(cls, model: SparseModel, capture: Capture) -> "_Part":
        """Gravity is a prior when there is refraction to see the plane by."""
        tracks = model.tracks
        images = model.registered.nonzero()[:, 0]
        rows = model.active.nonzero()[:, 0]
        ids, point = torch.unique_consecutive(tracks.track[rows], return_inverse=True)
        camera_of = torch.zeros(len(model.registered), dtype=torch.long)
        camera_of[images] = torch.arange(len(images))
        terms: list[Term] = []
        if bool(model.index_ratio > 1.0):
            terms.append(GravityPrior(capture.down_in_cam[images], capture.down_sigma))
        return cls(
            images,
            ids,
            BundleState(
                model.rotation[images], model.center[images], model.points[ids], model.intrinsics, model.index_ratio
            ),
            Observations(camera_of[tracks.image[rows]], point, tracks.pixels[rows]),
            terms,
        )


def adjust_model(
    model: SparseModel,
    capture: Capture,
    options: BundleOptions,
    callback: Heard | None = None,
) -> tuple[SparseModel, BundleReport]:
    """Adjust all registered cameras and all points, and whatever else `options.refine` names."""
    part = _Part.of(model, capture)
    report = adjust(part.state, part.observations, options, terms=part.terms, check=False, callback=callback)
    points = model.points.clone()
    points[part.ids] = report.state.points
    model = model.with_poses(part.images, report.state.rotation, report.state.center)
    return (
        replace(model, points=points, intrinsics=report.state.lens, index_ratio=report.state.index_ratio),
        report,
    )


def assess_model(model: SparseModel, capture: Capture, options: BundleOptions, held: dict[str, str]) -> Assessment:
    """How well everything is determined; held: what an adjustment refused to refine. Empty where nothing is known."""
    part = _Part.of(model, capture)
    if not len(part.observations):
        return Assessment()
    refine = tuple(name for name in options.refine if name not in held)
    layout = Layout.create(part.state, Links.single(part.state), refine)
    problem = BundleProblem.create(part.state, layout, part.observations, options, part.terms)
    return assess(problem, part.state, held)
