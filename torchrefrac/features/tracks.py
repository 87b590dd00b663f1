"""Tracks: connected components of matches."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from torchrefrac.features.sift import Features
from torchrefrac.numerics import components, first_equal
from torchrefrac.scene import Observations


@dataclass(frozen=True)
class PairMatches:
    """Matches between the keypoints of images `first` and `second`."""

    first: int
    second: int
    matches: Int[Tensor, "k 2"]

    def __len__(self) -> int:
        return len(self.matches)


def build_tracks(
    features: Sequence[Features], pairs: Sequence[PairMatches], min_length: int = 2
) -> tuple[Observations, UInt8[Tensor, "n 3"]]:
    """Join matches into tracks over all images: observations of n points, and the mean colour of each.

    Observations ascend by point, then by view, with the noise of the keypoints. Keypoints of one image at one position
    (SIFT gives a keypoint several orientations) count as one. A component that has two positions in one image is
    contradictory and dropped whole; so are those of fewer than `min_length` images.
    """
    counts = [len(f) for f in features]
    offset = np.concatenate(([0], np.cumsum(counts)))
    image = torch.from_numpy(np.repeat(np.arange(len(features)), counts))
    pixels = torch.cat([f.pixels for f in features])
    node = first_equal(torch.cat((image[:, None].double(), pixels), dim=-1))
    edges = [pair.matches + torch.tensor([offset[pair.first], offset[pair.second]]) for pair in pairs]
    edges = torch.cat(edges or [torch.zeros(0, 2, dtype=torch.long)])
    first, second = node[edges[:, 0]], node[edges[:, 1]]
    label = components(first, second, len(node))

    used = torch.unique(torch.cat((first, second)))
    component, image_of = label[used], image[used]
    key, times = torch.unique(component * len(features) + image_of, return_counts=True)
    contradictory = torch.zeros(int(label.max()) + 1 if len(label) else 0, dtype=torch.bool)
    contradictory[key[times > 1] // len(features)] = True
    length = torch.bincount(component, minlength=len(contradictory))
    chosen = ~contradictory[component] & (length[component] >= min_length)
    component, used = component[chosen], used[chosen]
    _, track = torch.unique(component, return_inverse=True)
    order = torch.argsort(track * len(features) + image[used])
    used, track = used[order], track[order]
    colors = torch.cat([f.colors for f in features])[used]
    noise = torch.cat([f.noise for f in features])[used]
    return Observations(image[used], track, pixels[used], noise=noise), _mean_colors(track, colors)


def _mean_colors(track: Int[Tensor, " k"], colors: UInt8[Tensor, "k 3"]) -> UInt8[Tensor, "n 3"]:
    """Of each of the tracks, which ascend and count from 0."""
    count = torch.bincount(track)
    total = torch.zeros(len(count), 3, dtype=torch.float64).index_add_(0, track, colors.double())
    return (total / count[:, None]).round().to(torch.uint8)
