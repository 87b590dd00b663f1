"""Several recorders as one."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

from torch import Tensor

from torchrefrac.recorder import Recorder

T = TypeVar("T")


class Recorders:
    """Passes everything on to each of `recorders`."""

    def __init__(self, *recorders: Recorder) -> None:
        self._recorders = recorders

    def scalar(self, name: str, value: float, step: int) -> None:
        for recorder in self._recorders:
            recorder.scalar(name, value, step)

    def cloud(self, name: str, points: Tensor, colors: Tensor, step: int) -> None:
        for recorder in self._recorders:
            recorder.cloud(name, points, colors, step)

    def note(self, text: str) -> None:
        for recorder in self._recorders:
            recorder.note(text)

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        for recorder in self._recorders:
            items = recorder.track(items, total, description, unit)
        yield from items
