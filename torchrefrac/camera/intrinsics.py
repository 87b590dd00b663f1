"""Focal length, principal point and distortion of a camera."""

from collections.abc import Callable, Sequence
from dataclasses import InitVar, dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera.distortion import distort, undistort
from torchrefrac.checks import at_least_single, require, require_broadcasting, require_ending, require_floating
from torchrefrac.numerics import pick

COMPONENTS = {"focal": 2, "principal_point": 2, "distortion": 5}


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Pinhole with Brown-Conrady distortion. Pixels: the centre of the top-left pixel is (0.5, 0.5).

    focal and principal_point, width and height in pixels; distortion as k1, k2, p1, p2, k3. Raises ValueError for
    shapes that do not fit, a focal length that is not finite and positive, and other values that are not finite;
    check=False leaves out the look at values.
    """

    width: int
    height: int
    focal: Float[Tensor, "*#batch 2"]
    principal_point: Float[Tensor, "*#batch 2"]
    distortion: Float[Tensor, "*#batch 5"]
    check: InitVar[bool] = True

    def __post_init__(self, check: bool) -> None:
        if min(self.width, self.height) < 1:
            raise ValueError(f"width and height are {self.width} and {self.height}, but must be at least 1 pixel")
        for name, components in COMPONENTS.items():
            require_ending(getattr(self, name), name, (components,))
            require_floating(getattr(self, name), name)
            object.__setattr__(self, name, at_least_single(getattr(self, name)))
        _ = self.shape
        if check:
            require(self.focal, "focal", above=0.0)
            require(self.principal_point, "principal_point")
            require(self.distortion, "distortion")

    @classmethod
    def create(
        cls,
        width: int,
        height: int,
        focal: float | Sequence[float],
        principal_point: Sequence[float] | None = None,
        distortion: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
        dtype: torch.dtype = torch.float64,
    ) -> "Intrinsics":
        """From plain numbers; one focal length serves both axes, the principal point is by default the middle."""
        both = (focal, focal) if isinstance(focal, int | float) else focal
        middle = (width / 2, height / 2) if principal_point is None else principal_point
        f, c, k = (torch.tensor(numbers, dtype=dtype) for numbers in (both, middle, distortion))
        return cls(width, height, f, c, k)

    def pixels_from_plane(self, xy: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Pixels of ideal image-plane coordinates x/z, y/z."""
        return distort(xy, self.distortion) * self.focal + self.principal_point

    def plane_from_pixels(self, pixels: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Ideal image-plane coordinates of pixels: the distortion is undone."""
        return undistort((pixels - self.principal_point) / self.focal, self.distortion)

    def pixel_grid(self, height: int | None = None, width: int | None = None) -> Float[Tensor, "rows columns 2"]:
        """Centres of pixels of equal size that cover the image; by default its own pixels."""
        rows = self.height if height is None else height
        columns = self.width if width is None else width
        if min(rows, columns) < 1:
            raise ValueError(f"height and width are {rows} and {columns}, but must be at least 1")
        y, x = (
            (torch.arange(count, dtype=self.focal.dtype, device=self.focal.device) + 0.5) * (size / count)
            for count, size in ((rows, self.height), (columns, self.width))
        )
        return torch.stack((x.expand(rows, -1), y[:, None].expand(-1, columns)), dim=-1)

    def contains(self, pixels: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
        """Mask of pixels inside the image."""
        x, y = pixels.unbind(dim=-1)
        return (x >= 0) & (x <= self.width) & (y >= 0) & (y <= self.height)

    @property
    def shape(self) -> torch.Size:
        """The batch shape *B."""
        return require_broadcasting(**{name: getattr(self, name).shape[:-1] for name in COMPONENTS})

    def indexed(self, index: Any, batch: Sequence[int]) -> "Intrinsics":
        """Those of some of the cameras of a batch (see `RefractiveCamera.__getitem__`)."""
        return self._with_each(lambda value: pick(value, index, batch, 1))

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "Intrinsics":
        """The same in another dtype or on another device."""
        return self._with_each(lambda value: value.to(dtype=dtype, device=device))

    def _with_each(self, change: Callable[[Any], Any]) -> "Intrinsics":
        changed = (change(getattr(self, name)) for name in COMPONENTS)
        return Intrinsics(self.width, self.height, *changed, check=False)
