"""Tensors that lie in files, so that their pages leave memory when others need it."""

import os
import tempfile
from pathlib import Path

import torch
from jaxtyping import Shaped
from torch import Tensor


def mapped(shape: tuple[int, ...], dtype: torch.dtype, folder: Path) -> Shaped[Tensor, "..."]:
    """A tensor of zeros on the disk of a folder, which is made if need be.

    Its file has no name any more, so that nothing stays when the tensor goes, or the process is killed.
    """
    count = torch.Size(shape).numel()
    if not count:
        return torch.zeros(shape, dtype=dtype)
    folder.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=".", suffix=".partial.bin", dir=folder)
    os.close(handle)
    try:
        return torch.from_file(name, shared=True, size=count, dtype=dtype).view(shape)
    finally:
        os.unlink(name)
