"""Standard output that somebody may stop reading, as `| head` does; imports nothing that is slow."""

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, TextIO


class Unbroken:
    """A stream that writes into nothing once nobody reads it any more; all else is that of `stream`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._give_up()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._give_up()

    def _give_up(self) -> None:
        """What still waits to be written goes the same way."""
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, self._stream.fileno())
        os.close(nothing)


@contextmanager
def unbroken_streams() -> Generator[None, None, None]:
    """While standard output and standard error may lose their readers."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(Unbroken, before)  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before
