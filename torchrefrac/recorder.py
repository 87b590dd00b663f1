"""Where a run reports to: the protocol that every stage may be given, and the one that keeps silent.

A leaf of the package: any layer may import it, sinks (a terminal, TensorBoard, a file) live in `torchrefrac.report`.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeVar

from torch import Tensor

T = TypeVar("T")
Advance = Callable[[int, str], None]


class Recorder(Protocol):
    """Receives what happens during a run. Every method may be a no-op."""

    @property
    def wants_pictures(self) -> bool:
        """Whether histograms, clouds and pictures are kept; where they are not, nobody needs to make any."""
        ...

    def scalar(self, name: str, value: float, step: int) -> None:
        """One point of a curve."""
        ...

    def histogram(self, name: str, values: Tensor, step: int) -> None:
        """How values (N) are distributed; those that are not finite are left out."""
        ...

    def picture(self, name: str, image: Tensor, step: int) -> None:
        """An image (H, W, 3) uint8 RGB."""
        ...

    def cloud(self, name: str, points: Tensor, colors: Tensor, step: int) -> None:
        """Points (N, 3) with colours (N, 3) uint8."""
        ...

    def note(self, text: str) -> None:
        """One line that a person should see."""
        ...

    def detail(self, text: str) -> None:
        """One line for a person who looks at the log later."""
        ...

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        """Pass `items` through, showing how far they are."""
        ...

    def meter(self, total: int, description: str, unit: str) -> AbstractContextManager[Advance]:
        """For work that comes in lumps: `advance(how many, what else to say)`. An empty unit: its lumps are no number
        that would mean anything to a person."""
        ...


class SilentRecorder:
    """Records nothing; for recorders of some of it to inherit from."""

    @property
    def wants_pictures(self) -> bool:
        return False

    def scalar(self, name: str, value: float, step: int) -> None: ...

    def histogram(self, name: str, values: Tensor, step: int) -> None: ...

    def picture(self, name: str, image: Tensor, step: int) -> None: ...

    def cloud(self, name: str, points: Tensor, colors: Tensor, step: int) -> None: ...

    def note(self, text: str) -> None: ...

    def detail(self, text: str) -> None: ...

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        yield from items

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Iterator[Advance]:
        yield lambda count, text: None
