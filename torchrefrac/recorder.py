"""Where a run reports to: the protocol that every stage may be given, and the one that records nothing.

A leaf of the package: any layer may import it, sinks (a terminal, TensorBoard, a file) live in `torchrefrac.record`.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, TypeVar

from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

T = TypeVar("T")
Advance = Callable[[int, str], None]


class Recorder(Protocol):
    """Receives what happens during a run. Every method may be a no-op, as it is by itself."""

    @property
    def wants_pictures(self) -> bool:
        """Whether histograms, clouds and pictures are recorded; where they are not, nobody needs to make any."""
        return False

    def scalar(self, name: str, value: float, step: int) -> None:
        """One point of a curve."""

    def histogram(self, name: str, values: Shaped[Tensor, " n"], step: int) -> None:
        """How values are distributed; those that are not finite are left out."""

    def picture(self, name: str, image: UInt8[Tensor, "height width 3"], step: int) -> None:
        """An image in RGB."""

    def cloud(self, name: str, points: Float[Tensor, "n 3"], colors: UInt8[Tensor, "n 3"], step: int) -> None:
        """Points with colours."""

    def note(self, text: str) -> None:
        """One line that a person should see."""

    def detail(self, text: str) -> None:
        """One line for a person who looks at the log later."""

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        """Pass `items` through, showing how far they are."""
        yield from items

    def meter(self, total: int, description: str, unit: str) -> AbstractContextManager[Advance]:
        """For work that comes in lumps: `advance(how many, further text)`. An empty unit: its lumps are no number
        that would mean anything to a person."""
        return nullcontext(lambda count, text: None)


class SilentRecorder(Recorder):
    """Records nothing; for recorders of some of it to inherit from."""
