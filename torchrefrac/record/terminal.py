"""Progress for a person at a terminal; plain lines where the output is not one."""

import sys
import textwrap
import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO, TypeVar

from tqdm import tqdm

from torchrefrac.record.log_file import plural
from torchrefrac.recorder import Advance, SilentRecorder

T = TypeVar("T")
WIDTH = 100
ALIVE_SECONDS = 30.0


def wrapped(line: str) -> str:
    """A line for the terminal, broken between words where it is too long for it."""
    return textwrap.fill(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


class TerminalRecorder(SilentRecorder):
    """Bars with rate and time left on a terminal. Elsewhere one line at the end of a stage, and one every half minute
    while it lasts. Curves, histograms, pictures and clouds are not shown.

    A context: leaving it ends the bars that still stand, so that what is printed next has a line of its own.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._bars: list[tqdm[Any]] = []

    def __enter__(self) -> "TerminalRecorder":
        return self

    def __exit__(self, *_: object) -> None:
        while self._bars:
            self._bars.pop().close()

    def note(self, text: str) -> None:
        tqdm.write(text, file=self._stream)

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        if self._stream.isatty():
            layout = "{desc}{bar} {n_fmt}/{total_fmt}{unit}  {rate_fmt}  {elapsed}<{remaining}"
            with self._bar(layout, total, description, f" {plural(unit, total)}") as bar:
                for item in items:
                    yield item
                    bar.update()
            return
        life = _Life(self._stream, total, description, unit)
        for item in items:
            yield item
            life.advance(1, "")
        life.end(f"{life.done}/{total}")

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Generator[Advance, None, None]:
        if not self._stream.isatty():
            life = _Life(self._stream, total, description, unit)
            yield life.advance
            life.end(f"{total}")
            return
        layout = "{desc}{bar} {percentage:3.0f} %{postfix}  {elapsed}<{remaining}"
        with self._bar(layout, total, description, unit) as bar:

            def show(count: int, text: str) -> None:
                if text:
                    bar.set_postfix_str(text, refresh=False)
                bar.update(count)

            yield show

    @contextmanager
    def _bar(self, layout: str, total: int, description: str, unit: str) -> "Generator[tqdm[Any], None, None]":
        """A bar that stays where it is when it ends, unless it stands below another one."""
        bar = tqdm(
            total=total, desc=f"{description:<12}", unit=unit, ncols=WIDTH, file=self._stream, bar_format=layout,
            leave=not self._bars,
        )  # fmt: skip
        self._bars.append(bar)
        try:
            yield bar
        finally:
            if bar in self._bars:
                self._bars.remove(bar)
            bar.close()


class _Life:
    """One stage in plain lines."""

    def __init__(self, stream: TextIO, total: int, description: str, unit: str) -> None:
        self._stream, self._total, self._unit, self._name = stream, total, plural(unit, total), f"{description:<12}"
        self._start = self._printed = time.perf_counter()
        self._latest = ""
        self.done = 0

    def advance(self, count: int, text: str) -> None:
        self.done, self._latest = self.done + count, text or self._latest
        now = time.perf_counter()
        if now - self._printed >= ALIVE_SECONDS and self.done < self._total:
            self._printed = now
            self._print(f"{100 * self.done // self._total} % after {now - self._start:.0f} s")

    def end(self, done: str) -> None:
        seconds = f"{time.perf_counter() - self._start:.1f} s"
        self._print(f"{done} {self._unit} in {seconds}" if self._unit else seconds)

    def _print(self, text: str) -> None:
        print(f"{self._name} {text}{', ' if self._latest else ''}{self._latest}", file=self._stream, flush=True)
