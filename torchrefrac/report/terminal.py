"""Progress for a person at a terminal; plain lines where the output is not one."""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TextIO, TypeVar

from torch import Tensor
from tqdm import tqdm

from torchrefrac.recorder import Advance

T = TypeVar("T")
WIDTH = 100


class TerminalRecorder:
    """Bars with rate and time left on a terminal, one line a stage elsewhere; curves and clouds are not shown."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr

    def scalar(self, name: str, value: float, step: int) -> None: ...

    def cloud(self, name: str, points: Tensor, colors: Tensor, step: int) -> None: ...

    def note(self, text: str) -> None:
        tqdm.write(text, file=self._stream)

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        if not self._stream.isatty():
            yield from self._plain(items, total, description, unit)
            return
        bar = tqdm(
            items, total=total, desc=f"{description:<12}", unit=f" {_plural(unit, total)}", ncols=WIDTH,
            file=self._stream, bar_format="{desc}{bar} {n_fmt}/{total_fmt}{unit}  {rate_fmt}  {elapsed}<{remaining}",
        )  # fmt: skip
        yield from bar

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Iterator[Advance]:
        if self._stream.isatty():
            bar = tqdm(
                total=total, desc=f"{description:<12}", ncols=WIDTH, file=self._stream,
                bar_format="{desc}{bar} {percentage:3.0f} %{postfix}  {elapsed}<{remaining}",
            )  # fmt: skip

            def show(count: int, text: str) -> None:
                if text:
                    bar.set_postfix_str(text, refresh=False)
                bar.update(count)

            with bar:
                yield show
            return
        start, said = time.perf_counter(), ""

        def remember(count: int, text: str) -> None:
            nonlocal said
            said = text or said

        yield remember
        line = f"{description:<12} {total} {_plural(unit, total)} in {time.perf_counter() - start:.1f} s"
        print(f"{line}, {said}" if said else line, file=self._stream, flush=True)

    def _plain(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        start, count = time.perf_counter(), 0
        for item in items:
            yield item
            count += 1
        seconds = time.perf_counter() - start
        line = f"{description:<12} {count}/{total} {_plural(unit, total)} in {seconds:.1f} s"
        print(line, file=self._stream, flush=True)


def _plural(unit: str, count: int) -> str:
    return unit if count == 1 else f"{unit}s"
