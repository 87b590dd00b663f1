"""Several recorders as one."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TypeVar

from torch import Tensor

from torchrefrac.recorder import Advance, Recorder

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

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Iterator[Advance]:
        with ExitStack() as stack:
            every = [stack.enter_context(r.meter(total, description, unit)) for r in self._recorders]

            def advance(count: int, text: str) -> None:
                for each in every:
                    each(count, text)

            yield advance
