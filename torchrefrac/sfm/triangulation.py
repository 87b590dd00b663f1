"""New points for tracks that two or more registered images see."""

from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.refinement import refine_points
from torchrefrac.sfm.model import SparseModel, pad_by_track
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.rays import triangulate_rays

DROP_ROUNDS = 3


def triangulate_tracks(model: SparseModel, options: SfmOptions) -> SparseModel:
    """Triangulate every track that has no point yet.

    A point is accepted when all its observations reproject within max_error and its rays open by min_angle_deg.
    While it fails, its worst observation is set aside, up to three times and down to two. Accepted points then
    move to where they reproject best.
    """
    rows = (model.visible() & ~model.has_point[model.tracks.track]).nonzero()[:, 0]
    ids, table, present = pad_by_track(model.tracks, rows)
    several = present.sum(dim=-1) >= 2
    ids, table, present = ids[several], table[several], present[several]
    if not len(ids):
        return model
    camera = model.cameras(model.tracks.image[table])
    pixels = model.tracks.pixels[table]
    points = model.points.clone()
    has_point, active = model.has_point.clone(), model.active.clone()
    pending = torch.ones(len(ids), dtype=torch.bool)
    for _ in range(1 + DROP_ROUNDS):
        lines = pending.nonzero()[:, 0]
        if not len(lines):
            break
        found, angle, valid = triangulate_rays(camera[lines], pixels[lines], present[lines])
        error = _errors(camera[lines].project(found[:, None]), pixels[lines], present[lines])
        good = valid & (error.amax(dim=-1) < options.max_error)
        wide = angle > options.min_angle_deg * torch.pi / 180.0
        accepted = lines[good & wide]
        points[ids[accepted]] = found[good & wide]
        has_point[ids[accepted]] = True
        active[table[accepted][present[accepted]]] = True
        failing = ~good
        present[lines[failing], error[failing].argmax(dim=-1)] = False
        pending[:] = False
        pending[lines[failing]] = present[lines[failing]].sum(dim=-1) >= 2
    new = has_point & ~model.has_point
    return _polish(replace(model, points=points, has_point=has_point, active=active), new, options)


def _polish(model: SparseModel, new: Tensor, options: SfmOptions) -> SparseModel:
    """The points `new` (T) at the least reprojection error of their active observations."""
    rows = (model.active & new[model.tracks.track]).nonzero()[:, 0]
    ids, point = torch.unique_consecutive(model.tracks.track[rows], return_inverse=True)
    cameras, pixels = model.cameras(model.tracks.image[rows]), model.tracks.pixels[rows]
    bundle = options.bundle
    estimate = refine_points(cameras, pixels, point, model.points[ids], bundle.pixel_sigma, bundle.loss_scale)
    return replace(model, points=model.points.index_copy(0, ids, estimate.points))


def _errors(projection: tuple[Tensor, Tensor], pixels: Tensor, present: Tensor) -> Tensor:
    projected, valid = projection
    error = torch.where(valid, (projected - pixels).norm(dim=-1), torch.inf)
    return torch.where(present, error, 0.0)
