"""The flat surface between camera and scene."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class FlatInterface:
    """A flat water surface in the plane z = 0: air above (z > 0), water below (z < 0).

    index_ratio: n_water / n_air >= 1, a number or a tensor that broadcasts against the camera's batch.
    1 is no interface at all: every ray is straight.
    """

    index_ratio: Tensor | float = 1.333

    def __post_init__(self) -> None:
        ratio = torch.as_tensor(self.index_ratio)
        if not bool((ratio.isfinite() & (ratio >= 1.0)).all()):
            raise ValueError(f"index_ratio is {self.index_ratio}, but must be finite and at least 1")

    def index_like(self, reference: Tensor) -> Tensor:
        """The index ratio in the dtype and on the device of `reference`."""
        return torch.as_tensor(self.index_ratio, dtype=reference.dtype, device=reference.device)
