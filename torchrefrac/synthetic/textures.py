"""Colours by texture coordinates: an image that is looked up, and several of them on one surface."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.nn import functional

from torchrefrac.synthetic.stage import Texture


@dataclass(frozen=True, eq=False)
class ImageTexture:
    """An image, RGB, spread over texture coordinates from 0 to 1: u to the right, v upwards.

    Between the centres of its texels it is interpolated bilinearly. Beyond 0 and 1 it continues with its outermost
    texels, or, with repeat, starts again, without a seam in the interpolation.
    """

    image: UInt8[np.ndarray, "height width 3"]
    repeat: bool = False

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.dtype != np.uint8 or not self.image.size:
            raise ValueError(f"image is {self.image.dtype} {self.image.shape}, but must be uint8 of shape (H, W, 3)")

    @cached_property
    def _channels(self) -> Float32[Tensor, "1 3 height width"]:
        """In memory channels last, so that a texel's colour is read at once; one texel wider on
        all sides where it repeats."""
        image = np.pad(self.image, ((1, 1), (1, 1), (0, 0)), mode="wrap") if self.repeat else self.image
        return torch.from_numpy(np.array(image, dtype=np.float32)).permute(2, 0, 1)[None]

    def __call__(self, uv: Float[Tensor, "n 2"]) -> Float32[Tensor, "n 3"]:
        if self.repeat:
            height, width = self.image.shape[:2]
            inner = torch.tensor((width / (width + 2.0), height / (height + 2.0)), dtype=uv.dtype)
            uv = 0.5 + (uv - uv.floor() - 0.5) * inner
        place = torch.stack((2.0 * uv[:, 0] - 1.0, 1.0 - 2.0 * uv[:, 1]), dim=-1).float()
        seen = functional.grid_sample(self._channels, place[None, None], padding_mode="border", align_corners=False)
        return seen[0, :, 0].mT


@dataclass(frozen=True, eq=False)
class SideBySide:
    """Several textures side by side along u: the first from u = 0 to 1, the next from 1 to 2, and so on, as the side
    and the two ends of a `Cylinder`."""

    textures: Sequence[Texture]

    def __call__(self, uv: Float[Tensor, "n 2"]) -> Float32[Tensor, "n 3"]:
        which = (uv[:, 0].ceil() - 1.0).clamp(0, len(self.textures) - 1).long()
        colours = torch.zeros(len(uv), 3)
        for index, texture in enumerate(self.textures):
            own = (which == index).nonzero()[:, 0]
            if len(own):
                colours[own] = texture(uv[own] - torch.tensor((float(index), 0.0), dtype=uv.dtype))
        return colours


@dataclass(frozen=True, eq=False)
class VertexColours:
    """Colours of each face's corners, interpolated over a mesh that has the texture coordinates of `corner_uv`."""

    colours: Float32[Tensor, "f 3 3"]

    def __call__(self, uv: Float[Tensor, "n 2"]) -> Float32[Tensor, "n 3"]:
        face = (uv[:, 0] / 2.0).floor().clamp(0, len(self.colours) - 1)
        second, third = uv[:, 0] - 2.0 * face - 0.5, uv[:, 1]
        weights = torch.stack((1.0 - second - third, second, third), dim=-1).clamp(0.0, 1.0).float()
        return (weights[..., None] * self.colours[face.long()]).sum(dim=1)


def corner_uv(faces: int) -> Float[Tensor, "vertices 2"]:
    """Texture coordinates of a mesh whose faces share no vertices: they tell the face, and the place in it."""
    first = 2.0 * torch.arange(faces, dtype=torch.float64) + 0.5
    zero = torch.zeros_like(first)
    corners = ((first, zero), (first + 1.0, zero), (first, zero + 1.0))
    return torch.stack([torch.stack(corner, dim=-1) for corner in corners], dim=1).reshape(-1, 2)
