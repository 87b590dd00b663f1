"""Where a run reports to: the protocol that every stage may be given, and the one that records nothing.

A leaf of the package: any layer may import it, sinks (a terminal, TensorBoard, a file) live in `torchrefrac.record`.
"""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeVar

from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

T = TypeVar("T")
Advance = Callable[[int, str], None]


class Recorder(Protocol):
    """Receives what happens during a run. Every method may be a no-op."""

    @property
    def wants_pictures(self) -> bool:
        """Whether histograms, clouds and pictures are recorded; where they are not, nobody needs to make any."""
        ...

    def scalar(self, name: str, value: float, step: int) -> None:
        """One point of a curve."""
        ...

    def histogram(self, name: str, values: Shaped[Tensor, " n"], step: int) -> None:
        """How values are distributed; those that are not finite are left out."""
        ...

    def picture(self, name: str, image: UInt8[Tensor, "height width 3"], step: int) -> None:
        """An image in RGB."""
        ...

    def cloud(self, name: str, points: Float[Tensor, "n 3"], colors: UInt8[Tensor, "n 3"], step: int) -> None:
        """Points with colours."""
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
        """For work that comes in lumps: `advance(how many, further text)`. An empty unit: its lumps are no number
        that would mean anything to a person."""
        ...


class SilentRecorder:
    """Records nothing; for recorders of some of it to inherit from."""

    @property
    def wants_pictures(self) -> bool:
        return False

    def scalar(self, name: str, value: float, step: int) -> None: ...

    def histogram(self, name: str, values: Shaped[Tensor, " n"], step: int) -> None: ...

    def picture(self, name: str, image: UInt8[Tensor, "height width 3"], step: int) -> None: ...

    def cloud(self, name: str, points: Float[Tensor, "n 3"], colors: UInt8[Tensor, "n 3"], step: int) -> None: ...

    def note(self, text: str) -> None: ...

    def detail(self, text: str) -> None: ...

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        yield from items

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Generator[Advance, None, None]:
        yield lambda count, text: None
