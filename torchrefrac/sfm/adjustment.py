"""Bundle adjustment of the growing model."""

from collections.abc import Callable
from dataclasses import replace

import torch

from torchrefrac.bundle import BundleOptions, BundleState, GravityPrior, Observations, adjust
from torchrefrac.scene import Capture
from torchrefrac.sfm.model import SparseModel


def adjust_model(
    model: SparseModel,
    capture: Capture,
    options: BundleOptions,
    callback: Callable[[int, float], None] | None = None,
) -> SparseModel:
    """Adjust all registered cameras and all points. Gravity is a prior when there is refraction to see the plane by."""
    tracks = model.tracks
    images = model.registered.nonzero()[:, 0]
    rows = model.active.nonzero()[:, 0]
    ids, point = torch.unique_consecutive(tracks.track[rows], return_inverse=True)
    camera_of = torch.zeros(len(model.registered), dtype=torch.long)
    camera_of[images] = torch.arange(len(images))
    refractive = bool(model.index_ratio > 1.0)
    report = adjust(
        BundleState(
            model.rotation[images], model.center[images], model.points[ids], model.intrinsics, model.index_ratio
        ),
        Observations(camera_of[tracks.image[rows]], point, tracks.pixels[rows]),
        options,
        terms=[GravityPrior(capture.down_in_cam[images], capture.down_sigma)] if refractive else [],
        check=False,
        callback=callback,
    )
    points = model.points.clone()
    points[ids] = report.state.points
    model = model.with_poses(images, report.state.rotation, report.state.center)
    return replace(model, points=points, intrinsics=report.state.lens, index_ratio=report.state.index_ratio)
