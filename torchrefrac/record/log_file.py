"""What happened in a run, as lines of text for a person who comes later."""

import platform
import sys
import time
import traceback
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, TypeVar

import torch

from torchrefrac.files.run import RunStatus
from torchrefrac.recorder import Advance, SilentRecorder

T = TypeVar("T")


class LogFile(SilentRecorder):
    """Writes `path`: when each stage began and ended, notes, details, and why a run failed; curves are not written.

    A context: leaving it writes the final status, and the error where there is one, with its traceback unless it is one
    of `expected`. about: lines of the beginning. append: after what is there. Every line is on disk when the method
    returns. Where the file cannot be written, standard error says so once and the run goes on without.
    """

    def __init__(
        self,
        path: Path,
        *,
        about: Mapping[str, Any] | None = None,
        expected: tuple[type[BaseException], ...] = (),
        append: bool = False,
    ) -> None:
        self._path, self._expected = path, expected
        self._stream: BinaryIO | None = None
        self._start = time.perf_counter()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = path.open("ab" if append else "wb", buffering=0)  # closing has nothing to write then
        except OSError as error:
            self._give_up(error)
        for name, value in (_setting() | dict(about or {})).items():
            self._write(f"{name}: {value}")

    def __enter__(self) -> "LogFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self.error(error)
        stopped = isinstance(error, KeyboardInterrupt)
        status = RunStatus.COMPLETE if error is None else RunStatus.INTERRUPTED if stopped else RunStatus.FAILED
        self._write(f"{status} after {time.perf_counter() - self._start:.1f} s")
        self._close()

    def note(self, text: str) -> None:
        self._write(text)

    def detail(self, text: str) -> None:
        self._write(text)

    def error(self, error: BaseException) -> None:
        """Why the run ends; with the traceback unless the error is one of those expected."""
        if isinstance(error, KeyboardInterrupt):
            return
        self._write(f"error: {' '.join(str(error).split()) or type(error).__name__}")
        if not isinstance(error, self._expected):
            for line in "".join(traceback.format_exception(error)).splitlines():
                self._write(f"  {line}")

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        with self.meter(total, description, unit) as advance:
            for item in items:
                yield item
                advance(1, "")

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Generator[Advance, None, None]:
        start, done, latest = time.perf_counter(), 0, ""

        def advance(count: int, text: str) -> None:
            nonlocal done, latest
            done, latest = done + count, text or latest

        self._write(f"{description} begins: {total} {plural(unit, total)}" if unit else f"{description} begins")
        ended = "broke off"
        try:
            yield advance
            ended = "ended"
        finally:
            seconds = time.perf_counter() - start
            counted = f": {done}/{total} {plural(unit, total)} in" if unit else " after"
            line = f"{description} {ended}{counted} {seconds:.1f} s"
            self._write(f"{line}, {latest}" if latest else line)

    def _write(self, text: str) -> None:
        if self._stream is None:
            return
        try:
            self._stream.write(f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S} {text}\n".encode())
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self._close()
        print(f"warning: {self._path} cannot be written ({error.strerror}); the run goes on without", file=sys.stderr)

    def _close(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            with suppress(OSError):
                stream.close()


def plural(unit: str, count: int) -> str:
    """The unit in the number that `count` asks for."""
    return unit if count == 1 or not unit else f"{unit}s"


def _setting() -> dict[str, Any]:
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    return {
        "torchrefrac": import_module("torchrefrac").__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "device": device,
        "threads": torch.get_num_threads(),
    }
