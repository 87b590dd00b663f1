"""Which observations and points deserve to stay."""

from dataclasses import replace

import torch

from torchrefrac.minimal import triangulation_angle
from torchrefrac.sfm.model import SparseModel, pad_by_track
from torchrefrac.sfm.options import SfmOptions


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
        camera = model.cameras(tracks.image[table])
        seen = torch.nn.functional.normalize(model.points[ids][:, None] - camera.center_in_world, dim=-1)
        has_point[ids] = triangulation_angle(seen, present) > options.min_angle_deg * torch.pi / 180.0
    return replace(model, has_point=has_point, active=active & has_point[tracks.track])
