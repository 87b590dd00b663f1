"""Where a run reports to: the protocol that every stage may be given, and the one that keeps silent.

A leaf of the package: any layer may import it, sinks (a terminal, TensorBoard) live in `torchrefrac.report`.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeVar

from torch import Tensor

T = TypeVar("T")
Advance = Callable[[int, str], None]


class Recorder(Protocol):
    """Receives what happens during a run. Every method may be a no-op."""

    def scalar(self, name: str, value: float, step: int) -> None:
        """One point of a curve."""
        ...

    def cloud(self, name: str, points: Tensor, colors: Tensor, step: int) -> None:
        """Points (N, 3) with colours (N, 3) uint8."""
        ...

    def note(self, text: str) -> None:
        """One line that a person should see."""
        ...

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        """Pass `items` through, showing how far they are."""
        ...

    def meter(self, total: int, description: str, unit: str) -> AbstractContextManager[Advance]:
        """For work that comes in lumps: `advance(how many, what else to say)`."""
        ...


class SilentRecorder:
    """Records nothing."""

    def scalar(self, name: str, value: float, step: int) -> None: ...

    def cloud(self, name: str, points: Tensor, colors: Tensor, step: int) -> None: ...

    def note(self, text: str) -> None: ...

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        yield from items

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Iterator[Advance]:
        yield lambda count, text: None
