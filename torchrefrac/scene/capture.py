"""A capture: the photographs of one scene and what is known about them."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.checks import TorchrefracError


class CaptureError(TorchrefracError, ValueError):
    """The capture cannot be used; the message names the file or field and the remedy."""


@dataclass(frozen=True)
class Capture:
    """Photographs with shared intrinsics, each with the direction of gravity where it is known.

    names and paths of m images; down_in_cam (m, 3) unit vectors with an expected error of down_sigma radians, which
    mean nothing unless has_gravity (they are the optical axes then, and down_sigma is infinite);
    height (m) above the water in length_unit where has_height (m) says that it was measured; index_ratio is
    n_water / n_air. heading (m): compass heading of the image's top after levelling, radians clockwise from north
    (world +y), with an error of degrees; it means nothing unless has_heading, and reports alone look at it. folder:
    where the capture was read from; truth, if any, lies beside it.
    """

    folder: Path
    names: tuple[str, ...]
    paths: tuple[Path, ...]
    intrinsics: Intrinsics
    index_ratio: float
    down_in_cam: Tensor
    down_sigma: float
    height: Tensor
    has_height: Tensor
    length_unit: str
    has_gravity: bool = True
    heading: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    has_heading: bool = False

    def __len__(self) -> int:
        return len(self.names)
