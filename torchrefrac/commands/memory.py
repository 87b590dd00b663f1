"""A lack of memory as one sentence, whoever reports it."""

from collections.abc import Generator
from contextlib import contextmanager

import cv2
import torch

from torchrefrac.checks import TorchrefracError

SIGNS = ("can't allocate memory", "not enough memory", "out of memory", "Insufficient memory")
REMEDY = "use smaller images, fewer features (features.max_features) or a smaller dense.max_tile"


class MemoryLackError(TorchrefracError, RuntimeError):
    """There is not enough memory; the message says what would need less."""


@contextmanager
def memory_lack_explained() -> Generator[None, None, None]:
    """Raise MemoryLackError where Python, NumPy, PyTorch or OpenCV run out of memory."""
    try:
        yield
    except MemoryLackError:
        raise
    except (MemoryError, RuntimeError, cv2.error) as error:
        if not _is_lack(error):
            raise
        words = " ".join(str(error).split("\n", maxsplit=1)[0].split()) or type(error).__name__
        raise MemoryLackError(f"there is not enough memory ({words}); {REMEDY}") from error


def _is_lack(error: Exception) -> bool:
    return isinstance(error, MemoryError | torch.cuda.OutOfMemoryError) or any(sign in str(error) for sign in SIGNS)
