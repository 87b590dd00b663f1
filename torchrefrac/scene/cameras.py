"""Cameras: intrinsics, each shared by many views."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.camera import Intrinsics


@dataclass(frozen=True, eq=False)
class Cameras:
    """A table of intrinsics (see `Intrinsics`), and the size of the images of each in pixels, (width, height)."""

    sizes: tuple[tuple[int, int], ...]
    focal: Float[Tensor, "g 2"]
    principal_point: Float[Tensor, "g 2"]
    distortion: Float[Tensor, "g 5"]

    @classmethod
    def of(cls, every: Iterable[Intrinsics]) -> "Cameras":
        """From single intrinsics. Raises ValueError where some are batched."""
        every = tuple(every)
        for i, one in enumerate(every):
            if one.shape != ():
                raise ValueError(f"intrinsics[{i}] has batch shape {tuple(one.shape)}, but must be those of one camera")
        if not every:
            return cls((), torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0, 5))
        return cls(
            tuple((one.width, one.height) for one in every),
            torch.stack([one.focal for one in every]),
            torch.stack([one.principal_point for one in every]),
            torch.stack([one.distortion for one in every]),
        )

    def __len__(self) -> int:
        return len(self.sizes)

    def __getitem__(self, camera: int) -> Intrinsics:
        """The intrinsics of one."""
        return self._entries(camera, camera)

    def of_views(self, camera: Any) -> Intrinsics:
        """The intrinsics of views with the cameras `camera` (*B) as a batch (*B); not batched where there is one camera
        for all. Width and height are those of the first."""
        if len(self) == 1:
            return self[0]
        return self._entries(0, camera)

    def _entries(self, size: int, camera: Any) -> Intrinsics:
        focal, principal_point, distortion = self.focal[camera], self.principal_point[camera], self.distortion[camera]
        return Intrinsics(*self.sizes[size], focal, principal_point, distortion, check=False)

    def detached(self) -> "Cameras":
        """The same without a graph."""
        return replace(
            self,
            focal=self.focal.detach(),
            principal_point=self.principal_point.detach(),
            distortion=self.distortion.detach(),
        )
