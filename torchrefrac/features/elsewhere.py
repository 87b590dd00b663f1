"""Keypoints and matches that other programs made, as those that are made here."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from torchrefrac.features.sift import Features
from torchrefrac.features.tracks import PairMatches
from torchrefrac.files.correspondences import Correspondences


@dataclass(frozen=True)
class MadeElsewhereOptions:
    """path: of a COLMAP database, or of keypoints of hloc (HDF5), whose matches are in the file `matches`."""

    path: str
    matches: str | None = None
    method: Literal["file"] = "file"

    def __post_init__(self) -> None:
        if not self.path.strip():
            raise ValueError("path is empty, but must be a COLMAP database, or a file of keypoints of hloc")

    @property
    def paths(self) -> tuple[Path, Path | None]:
        """Of keypoints, and of their matches where these have a file of their own."""
        return Path(self.path), None if self.matches is None else Path(self.matches)


def features_and_matches(
    found: Correspondences, used: Sequence[Bool[Tensor, " _"]], colors: Sequence[UInt8[Tensor, "_ 3"]]
) -> tuple[list[Features], list[PairMatches]]:
    """Of each image the keypoints that may be used, and their matches in pairs of images that have any.

    Descriptors have no numbers: nothing more is matched by them, and no track completed.
    """
    place = [of_image.cumsum(0) - 1 for of_image in used]
    features = [
        Features(
            pixels=pixels[of_image],
            descriptors=torch.zeros(int(of_image.sum()), 0),
            colors=color[of_image],
            noise=torch.ones(int(of_image.sum()), dtype=torch.float64),
        )
        for pixels, of_image, color in zip(found.pixels, used, colors, strict=True)
    ]
    pairs = []
    for (i, j), rows in found.matches.items():
        both = rows[used[i][rows[:, 0]] & used[j][rows[:, 1]]]
        pairs.append(PairMatches(i, j, torch.stack((place[i][both[:, 0]], place[j][both[:, 1]]), dim=-1)))
    return features, pairs
