"""The pixels of many photographs in one file, of which any can be read at once."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from filelock import FileLock
from jaxtyping import Int, UInt8
from numpy.lib.format import open_memmap
from torch import Tensor

from torchrefrac.files.fingerprint import fingerprint_of
from torchrefrac.files.masks import Masks
from torchrefrac.files.paths import user_cache
from torchrefrac.files.photographs import read_color
from torchrefrac.scene import Capture

VERSION = 1
"""Of what the file holds. Raise it whenever that changes."""
USED = 255


class PixelTable:
    """Red, green, blue and whether it may be used (0 or 255) of every pixel of some photographs, row by row, one
    photograph after the other, in a file that is mapped into memory: processes share what they have read of it.

    sizes: width and height of each photograph, made smaller by the whole number `smaller`: each pixel is the mean of so
    many by so many, and is used where all of these are.
    """

    def __init__(self, capture: Capture, smaller: int = 1, cache: Path | None = None) -> None:
        """cache: where the file is, or is made; by default rays/ in the folder of the environment variable
        TORCHREFRAC_CACHE or in torchrefrac/ of the user's cache. Raises CaptureError for a photograph or a mask that
        cannot be read."""
        each = [capture.cameras.sizes[camera] for camera in capture.camera.tolist()]
        self.sizes = [(width // smaller, height // smaller) for width, height in each]
        counts = torch.tensor([width * height for width, height in self.sizes])
        self.starts = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
        masks = Masks(capture)
        made_from = VERSION, smaller, capture.paths, masks.paths, each
        self.path = (cache or user_cache() / "rays") / f"pixels_{fingerprint_of(*made_from)}.npy"
        if not self.path.is_file():
            with _alone(self.path):
                if not self.path.is_file():
                    self._make(capture, masks, smaller)
        self._table: UInt8[np.ndarray, "pixels 4"] = np.load(self.path, mmap_mode="r")

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_table"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._table = np.load(self.path, mmap_mode="r")

    def __getitem__(self, numbers: Int[Tensor, " n"]) -> UInt8[Tensor, "n 4"]:
        return torch.from_numpy(self._table[numbers.numpy()])

    def image(self, photograph: int) -> UInt8[Tensor, "height width 4"]:
        width, height = self.sizes[photograph]
        start = int(self.starts[photograph])
        return torch.from_numpy(np.array(self._table[start : start + width * height])).unflatten(0, (height, width))

    def _make(self, capture: Capture, masks: Masks, smaller: int) -> None:
        partial = self.path.with_name(f"{self.path.name}.partial")
        table = open_memmap(partial, "w+", np.uint8, (len(self), 4))
        for photograph, path in enumerate(capture.paths):
            used, (width, height) = masks.used(photograph), self.sizes[photograph]
            start = int(self.starts[photograph])
            place = table[start : start + width * height].reshape(height, width, 4)
            place[..., :3] = _means(read_color(path)[..., ::-1], width, height, smaller)
            if used is None:
                place[..., 3] = USED
            else:
                blocks = used[: height * smaller, : width * smaller].view(height, smaller, width, smaller)
                place[..., 3] = USED * blocks.all(dim=3).all(dim=1).numpy().astype(np.uint8)
        table.flush()
        del table
        os.replace(partial, self.path)


def _means(
    image: UInt8[np.ndarray, "rows columns 3"], width: int, height: int, smaller: int
) -> UInt8[np.ndarray, "height width 3"]:
    whole = np.ascontiguousarray(image[: height * smaller, : width * smaller])
    return whole if smaller == 1 else cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):
        yield
