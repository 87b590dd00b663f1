"""Focal length, principal point and distortion of a camera."""

from collections.abc import Callable, Sequence
from dataclasses import InitVar, dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera.distortion import distort, undistort
from torchrefrac.checks import at_least_single, require, require_broadcasting, require_ending, require_floating
from torchrefrac.numerics import pick

COMPONENTS = ("focal", "principal_point", "distortion")
COEFFICIENTS = ((0,), (5,), (8,))
"""What the shape of distortion may end in."""
MODELS = {"opencv": (0, 4, 5, 8), "fisheye": (4,)}
"""Models of distortion by their names, and how many coefficients each may have."""


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Pinhole with distortion. Pixels: the centre of the top-left pixel is (0.5, 0.5).

    focal and principal_point, width and height in pixels; distortion as OpenCV's k1, k2, p1, p2, k3, or with k4, k5, k6
    of its rational model, or of no numbers. fisheye: of which cameras they are k1, k2, k3, k4 of OpenCV's fisheye model
    instead; None: of none. sizes: width and height of each camera of a batch whose images differ; width and height are
    the largest then. Raises ValueError for shapes that do not fit, a focal length that is not finite and positive, and
    other values that are not finite; check=False leaves out the look at values.
    """

    width: int
    height: int
    focal: Float[Tensor, "*#batch 2"]
    principal_point: Float[Tensor, "*#batch 2"]
    distortion: Float[Tensor, "*#batch k"]
    fisheye: Bool[Tensor, "*#batch"] | None = None
    sizes: Float[Tensor, "*#batch 2"] | None = None
    check: InitVar[bool] = True

    def __post_init__(self, check: bool) -> None:
        if min(self.width, self.height) < 1:
            raise ValueError(f"width and height are {self.width} and {self.height}, but must be at least 1 pixel")
        if self.distortion.shape[-1:] not in COEFFICIENTS:
            raise ValueError(f"distortion has shape {tuple(self.distortion.shape)}, but must end in 0, 5 or 8 numbers")
        for name in COMPONENTS:
            if name != "distortion":
                require_ending(getattr(self, name), name, (2,))
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
        model: str = "opencv",
    ) -> "Intrinsics":
        """From plain numbers; one focal length serves both axes, the principal point is by default the middle.

        distortion: 0, 4, 5 or 8 coefficients of the model "opencv", or 4 of "fisheye" (by default zeros). Raises
        ValueError for another model, or another number of coefficients.
        """
        if model not in MODELS:
            raise ValueError(f"model is {model!r}, but must be one of {', '.join(MODELS)}")
        numbers = (0.0,) * 4 if model == "fisheye" and not any(distortion) else tuple(distortion)
        if len(numbers) not in MODELS[model]:
            wanted = " or ".join(map(str, MODELS[model]))
            raise ValueError(f"distortion has {len(numbers)} numbers, but must have {wanted} with the model {model}")
        both = (focal, focal) if isinstance(focal, int | float) else focal
        middle = (width / 2, height / 2) if principal_point is None else principal_point
        numbers += (0.0,) * (5 - len(numbers))
        f, c, k = (torch.tensor(values, dtype=dtype) for values in (both, middle, numbers))
        return cls(width, height, f, c, k, torch.tensor(True) if model == "fisheye" else None)

    def pixels_from_plane(self, xy: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Pixels of ideal image-plane coordinates x/z, y/z."""
        return distort(xy, self.distortion, self.fisheye) * self.focal + self.principal_point

    def plane_from_pixels(self, pixels: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Ideal image-plane coordinates of pixels: the distortion is undone."""
        return undistort((pixels - self.principal_point) / self.focal, self.distortion, self.fisheye)

    def pixel_grid(self, height: int | None = None, width: int | None = None) -> Float[Tensor, "rows columns 2"]:
        """Centres of pixels of equal size that cover the image; by default its own pixels.

        Raises ValueError for less than one row or column.
        """
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
        width, height = (self.width, self.height) if self.sizes is None else self.sizes.unbind(dim=-1)
        return (x >= 0) & (x <= width) & (y >= 0) & (y <= height)

    @property
    def shape(self) -> torch.Size:
        """The batch shape *B."""
        shapes = {name: getattr(self, name).shape[:-1] for name in COMPONENTS}
        if self.fisheye is not None:
            shapes["fisheye"] = self.fisheye.shape
        if self.sizes is not None:
            shapes["sizes"] = self.sizes.shape[:-1]
        return require_broadcasting(**shapes)

    def indexed(self, index: Any, batch: Sequence[int]) -> "Intrinsics":
        """Those of some of the cameras of a batch (see `RefractiveCamera.__getitem__`)."""
        return self._with_each(lambda value: pick(value, index, batch, 1), lambda mask: pick(mask, index, batch))

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "Intrinsics":
        """The same in another dtype or on another device."""
        return self._with_each(lambda value: value.to(dtype=dtype, device=device), lambda mask: mask.to(device=device))

    def without_idle_distortion(self) -> "Intrinsics":
        """The same where no coefficient of the distortion is other than zero: without them nothing is computed."""
        idle = self.fisheye is None and not bool(self.distortion.any())
        return replace(self, distortion=self.distortion[..., :0], check=False) if idle else self

    def _with_each(self, change: Callable[[Any], Any], change_mask: Callable[[Any], Any]) -> "Intrinsics":
        return Intrinsics(
            self.width,
            self.height,
            *(change(getattr(self, name)) for name in COMPONENTS),
            fisheye=None if self.fisheye is None else change_mask(self.fisheye),
            sizes=None if self.sizes is None else change(self.sizes),
            check=False,
        )
