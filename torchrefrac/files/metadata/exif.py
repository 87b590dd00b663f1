"""EXIF tags and maker notes, by the names of ExifRead."""

import io
import logging
import math
import struct
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import exifread

MOST_READS = 200_000  # of one file; a large maker note takes a third
BROKEN = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, struct.error, ZeroDivisionError)
"""What ExifRead raises on tags that are not whole."""

logging.getLogger("exifread").setLevel(logging.CRITICAL)  # what it warns of is no matter for the user


class _Bounded(io.BufferedReader):
    """A file that gives up where a wrong count makes its reader go on for ever."""

    left = MOST_READS

    def read(self, size: int | None = -1, /) -> bytes:
        self.left -= 1
        if self.left < 0:
            raise ValueError("too many reads")
        return super().read(size)


class Exif:
    """The tags of one file; none where it has no EXIF, or what it has is broken."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __bool__(self) -> bool:
        return bool(self._tags)

    def text(self, name: str) -> str:
        """Without spaces around it; empty where there is none."""
        value = getattr(self._tag(name), "values", "")
        if isinstance(value, list):  # bytes, as of a comment
            value = bytes(byte for byte in value if isinstance(byte, int) and 0 < byte < 256).decode("latin-1")
        return value.strip() if isinstance(value, str) else ""

    def numbers(self, name: str) -> list[float]:
        """Empty where there are none, or one of them is no number."""
        values = getattr(self._tag(name), "values", [])
        numbers = [_number(value) for value in values] if isinstance(values, list) else []
        return [] if None in numbers else [number for number in numbers if number is not None]

    def number(self, name: str) -> float | None:
        """The first."""
        numbers = self.numbers(name)
        return numbers[0] if numbers else None

    @property
    def maker_note(self) -> bytes:
        """As it is; empty where there is none."""
        return bytes(int(byte) for byte in self.numbers("EXIF MakerNote"))

    def _tag(self, name: str) -> Any:
        slow = name.startswith("MakerNote") or name in ("EXIF MakerNote", "EXIF UserComment")
        return (self._all if slow else self._tags).get(name)

    @cached_property
    def _tags(self) -> Mapping[str, Any]:
        return self._read(details=False)

    @cached_property
    def _all(self) -> Mapping[str, Any]:
        """With maker notes and comments, which take ten times as long."""
        return self._read(details=True)

    def _read(self, details: bool) -> Mapping[str, Any]:
        try:
            with _Bounded(io.FileIO(self._path)) as file:
                return exifread.process_file(file, details=details, extract_thumbnail=False)
        except BROKEN:
            return {}


def _number(value: Any) -> float | None:
    """Ratios, whole numbers, and floats, which come as tuples; 0/0 is none, and neither is what is not finite."""
    if isinstance(value, tuple):
        value = value[0] if value else None
    if getattr(value, "denominator", 1) == 0 or isinstance(value, str | bytes | bool | None):
        return None
    return float(value) if math.isfinite(value) else None
