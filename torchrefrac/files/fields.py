"""Typed access to the fields of a JSON file, with errors that name the file and the field."""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrefrac.scene import AlignmentError, CaptureError


def read_json(path: Path) -> "Fields":
    """Parse a JSON object."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CaptureError(f"{path} does not exist; it describes the capture and must lie beside images/") from None
    except IsADirectoryError:
        raise CaptureError(f"{path} is a folder, but must be a JSON file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path} is not valid JSON: {error}") from None
    return Fields(content, path, "")


class Fields:
    """One JSON object, and where it stands."""

    def __init__(self, content: Any, path: Path, prefix: str) -> None:
        if not isinstance(content, dict):
            raise CaptureError(f"{path}: {prefix or 'the top level'} is {_kind(content)}, but must be an object")
        self._content: dict[str, Any] = content
        self._path = path
        self._prefix = prefix

    def __contains__(self, name: str) -> bool:
        return self._content.get(name) is not None

    def fail(self, name: str, problem: str) -> CaptureError:
        """The error for field `name`, ready to raise."""
        return CaptureError(f"{self._path}: {self._label(name)} {problem}")

    def only(self, *known: str) -> None:
        """Refuse fields that nobody reads: they are misspelt more often than not."""
        for name in self._content:
            if name not in known:
                raise self.fail(name, f"is not a known field; known here are {', '.join(known)}")

    def text(self, name: str) -> str:
        value = self._get(name)
        if not isinstance(value, str) or not value:
            raise self.fail(name, f"is {_kind(value)}, but must be a non-empty string")
        return value

    def number(self, name: str) -> float:
        return self._number(name, self._get(name))

    def integer(self, name: str) -> int:
        value = self._get(name)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.fail(name, f"is {_kind(value)}, but must be a whole number")
        return value

    def numbers(self, name: str, count: int) -> list[float]:
        value = self._get(name)
        if not isinstance(value, list) or len(value) != count:
            raise self.fail(name, f"is {_kind(value)}, but must be a list of {count} numbers")
        return [self._number(f"{name}[{i}]", item) for i, item in enumerate(value)]

    def matrix(self, name: str) -> list[list[float]]:
        """A 3x3 matrix as three rows."""
        value = self._get(name)
        if not isinstance(value, list) or len(value) != 3:
            raise self.fail(name, f"is {_kind(value)}, but must be 3 rows of 3 numbers")
        rows = Fields({f"{name}[{i}]": row for i, row in enumerate(value)}, self._path, self._prefix)
        return [rows.numbers(f"{name}[{i}]", 3) for i in range(3)]

    def object(self, name: str) -> "Fields":
        return Fields(self._get(name), self._path, self._label(name))

    def objects(self, name: str) -> "list[Fields]":
        value = self._get(name)
        if not isinstance(value, list):
            raise self.fail(name, f"is {_kind(value)}, but must be a list of objects")
        return [Fields(item, self._path, f"{self._label(name)}[{i}]") for i, item in enumerate(value)]

    def _number(self, name: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail(name, f"is {_kind(value)}, but must be a number")
        if not math.isfinite(value):
            raise self.fail(name, f"is {value}, but must be finite")
        return float(value)

    def _get(self, name: str) -> Any:
        if name not in self._content:
            raise self.fail(name, "is missing")
        return self._content[name]

    def _label(self, name: str) -> str:
        return f"{self._prefix}.{name}" if self._prefix else name


def _kind(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value)


@contextmanager
def alignment_errors() -> Iterator[None]:
    """Raise what the checked reading of JSON fields finds as AlignmentError."""
    try:
        yield
    except CaptureError as error:
        raise AlignmentError(str(error)) from None


def read_object(path: Path) -> tuple[dict[str, Any], Fields]:
    """A JSON object, as it is and with checked access; to be called within `alignment_errors`."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, IsADirectoryError):
        raise AlignmentError(f"{path} is not a file, but must be one of JSON") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise AlignmentError(f"{path} is not valid JSON: {error}") from None
    return content, Fields(content, path, "")
