"""Curves and clouds for TensorBoard."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from torchrefrac.recorder import Advance

T = TypeVar("T")


class TensorBoardRecorder:
    """Writes events into `folder`, flushed every few seconds so that a running job can be watched; closes on exit."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - slow to import

        self._writer = SummaryWriter(str(folder), flush_secs=5)

    def __enter__(self) -> "TensorBoardRecorder":
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def scalar(self, name: str, value: float, step: int) -> None:
        self._writer.add_scalar(name, value, step)

    def cloud(self, name: str, points: Tensor, colors: Tensor, step: int) -> None:
        if len(points):
            self._writer.add_mesh(name, points[None].float(), colors[None].int(), global_step=step)

    def note(self, text: str) -> None: ...

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        yield from items

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Iterator[Advance]:
        yield lambda count, text: None
