"""Tracks: which keypoints of which images show the same scene point."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Tracks:
    """Flat table of N observations in T tracks, sorted by track; an image occurs at most once in a track.

    image, track (N); pixels (N, 2); colors (N, 3) uint8.
    """

    image: Tensor
    track: Tensor
    pixels: Tensor
    colors: Tensor
    num_tracks: int

    def mean_colors(self) -> Tensor:
        """(num_tracks, 3) uint8."""
        total = torch.zeros(self.num_tracks, 3, dtype=torch.float64).index_add_(0, self.track, self.colors.double())
        count = torch.bincount(self.track, minlength=self.num_tracks).clamp(min=1)
        return (total / count[:, None]).round().to(torch.uint8)
