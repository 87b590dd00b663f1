"""Several recorders as one, and those that every run has."""

from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from torchrefrac.files.run import PARTS, WORK
from torchrefrac.files.swap import home
from torchrefrac.record.log_file import LogFile
from torchrefrac.record.tensorboard import TensorBoardRecorder, remove_events
from torchrefrac.record.terminal import TerminalRecorder
from torchrefrac.recorder import Advance, Recorder

T = TypeVar("T")
EVENTS, LOG = "events", "run.log"


class Recorders:
    """Passes everything on to each of `recorders`."""

    def __init__(self, *recorders: Recorder) -> None:
        self._recorders = recorders

    @property
    def wants_pictures(self) -> bool:
        return any(recorder.wants_pictures for recorder in self._recorders)

    def scalar(self, name: str, value: float, step: int) -> None:
        for recorder in self._recorders:
            recorder.scalar(name, value, step)

    def histogram(self, name: str, values: Shaped[Tensor, " n"], step: int) -> None:
        for recorder in self._recorders:
            recorder.histogram(name, values, step)

    def picture(self, name: str, image: UInt8[Tensor, "height width 3"], step: int) -> None:
        for recorder in self._recorders:
            recorder.picture(name, image, step)

    def cloud(self, name: str, points: Float[Tensor, "n 3"], colors: UInt8[Tensor, "n 3"], step: int) -> None:
        for recorder in self._recorders:
            recorder.cloud(name, points, colors, step)

    def note(self, text: str) -> None:
        for recorder in self._recorders:
            recorder.note(text)

    def detail(self, text: str) -> None:
        for recorder in self._recorders:
            recorder.detail(text)

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        for recorder in self._recorders:
            items = recorder.track(items, total, description, unit)
        yield from items

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Generator[Advance, None, None]:
        with ExitStack() as stack:
            every = [stack.enter_context(r.meter(total, description, unit)) for r in self._recorders]

            def advance(count: int, text: str) -> None:
                for each in every:
                    each(count, text)

            yield advance


class RunRecorders(Recorders):
    """What a run reports to: `board`, and the others."""

    def __init__(self, board: TensorBoardRecorder, *others: Recorder) -> None:
        super().__init__(*others, board)
        self._board = board

    def hparams(self, options: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
        """One line of TensorBoard's table of runs, see `TensorBoardRecorder.hparams`."""
        self._board.hparams(options, metrics)


@contextmanager
def run_recorders(
    folder: Path,
    quiet: bool = False,
    *,
    about: Mapping[str, Any] | None = None,
    expected: tuple[type[BaseException], ...] = (),
    append: bool = False,
) -> Generator[RunRecorders, None, None]:
    """The recorders of one run: TensorBoard in `folder`/events, `folder`/run.log, and the terminal unless quiet.

    about: what the log should say of the run at its beginning, such as its command line. expected: errors whose message
    says it all; the log has the traceback of all others. append: keep the log and the events that lie there, as do runs
    that go on with an unfinished dense stage; otherwise they are begun again.

    All are closed, and bars that still stand on the terminal ended, whatever happens; an error goes through as it is.
    """
    append = append or any((home(folder) / parts).is_dir() for parts in (PARTS, WORK))
    if not append:
        remove_events(folder / EVENTS)
    with ExitStack() as stack:
        log = stack.enter_context(LogFile(folder / LOG, about=about, expected=expected, append=append))
        board = stack.enter_context(TensorBoardRecorder(folder / EVENTS))
        shown = [] if quiet else [stack.enter_context(TerminalRecorder())]
        yield RunRecorders(board, log, *shown)
