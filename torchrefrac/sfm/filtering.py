"""Which observations and points deserve to stay."""

from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.sfm.model import SparseModel, pad_by_track
from torchrefrac.sfm.options import SfmOptions
from torchrefrac.sfm.rays import opening_angle

MIN_OBSERVATIONS = 6


def filter_points(model: SparseModel, options: SfmOptions, min_length: int = 2) -> SparseModel:
    """Judge all observations anew: keep those within max_error, and points with enough of them and enough angle.

    An observation that was set aside comes back when its error has become small.
    """
    active = model.errors() < options.max_error
    tracks = model.tracks
    count = torch.bincount(tracks.track[active], minlength=tracks.num_tracks)
    long_enough = model.has_point & (count >= min_length)
    rows = (active & long_enough[tracks.track]).nonzero()[:, 0]
    ids, table, present = pad_by_track(tracks, rows)
    has_point = torch.zeros_like(model.has_point)
    if len(ids):
        angle = opening_angle(model.cameras(tracks.image[table]), tracks.pixels[table], present, model.points[ids])
        has_point[ids] = angle > options.min_angle_deg * torch.pi / 180.0
    return replace(model, has_point=has_point, active=active & has_point[tracks.track])


def affordable_length(model: SparseModel, options: SfmOptions) -> int:
    """The track length that can be asked for: min_track_length, or less where an image would be left without support.

    Points that only two images see are the least certain, but where photographs overlap little they are all there is.
    """
    for length in range(min(options.min_track_length, model.num_registered), 2, -1):
        support = _support(filter_points(model, options, length))[model.registered]
        if int(support.min()) >= options.min_registration_inliers:
            return length
    return 2


def drop_unsupported_images(model: SparseModel) -> tuple[SparseModel, list[int]]:
    """Take back the registration of images that fewer than MIN_OBSERVATIONS points support; and which they are."""
    lost = model.registered & (_support(model) < MIN_OBSERVATIONS)
    active = model.active & ~lost[model.tracks.image]
    return replace(model, registered=model.registered & ~lost, active=active), lost.nonzero()[:, 0].tolist()


def _support(model: SparseModel) -> Tensor:
    """Observations of points in each image (m)."""
    return torch.bincount(model.tracks.image[model.active], minlength=len(model.registered))
