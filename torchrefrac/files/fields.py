"""Typed access to the fields of a JSON file, with errors that name the file and the field."""

import json
import math
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrefrac.atomic import replacing
from torchrefrac.checks import TorchrefracError
from torchrefrac.scene import CaptureError, SceneError

MEGABYTE = 1_000_000
MOST_MEGABYTES = 32  # of a file that people or other programs write; about a second's work
MOST_MEGABYTES_OF_A_SCENE = 256  # of one that a run may have written
MOST_OBJECTS = 100_000  # in one list
FARTHEST = 1e12  # from the origin, in any unit
OFF_A_ROTATION = 1e-3  # of products of its rows
MOST_CHARACTERS = 1000  # of a text
MOST_OF_A_UNIT = 30  # characters
MOST_SHOWN = 100  # characters of a text in a sentence
MOST_DIGITS = 18  # of a whole number; a longer one is read as a float


def read_json(
    path: Path,
    missing: str = "does not exist; it describes the capture and must lie beside images/",
    most: int = MOST_MEGABYTES,
) -> "Fields":
    """Parse a JSON object of at most `most` megabytes, with or without a byte order mark.

    missing: what is said of a file that does not exist. Whole numbers beyond the range of a float become infinite, and
    are refused as such where they are read. Raises CaptureError with one sentence for whatever is wrong with the file.
    """
    try:
        size = path.stat().st_size / MEGABYTE
        if size > most:
            raise CaptureError(f"{path} has {size:.0f} MB, but must have at most {most}; is it the right file?")
        text = path.read_text(encoding="utf-8-sig")
        content = json.loads(text, object_pairs_hook=_unique, parse_int=_whole_number)
    except FileNotFoundError:
        raise CaptureError(f"{path} {missing}") from None
    except IsADirectoryError:
        raise CaptureError(f"{path} is a folder, but must be a JSON file") from None
    except RecursionError:
        raise CaptureError(f"{path} is nested more deeply than anything that is read here; write it anew") from None
    except _TwiceError as error:
        raise CaptureError(f"{path}: {error} is given twice in one object, but names must differ") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path} is not valid JSON: {error}") from None
    return Fields(content, path, "")


class _TwiceError(TorchrefracError):
    """The name that an object has twice."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of these names and values. Raises _TwiceError where two names are the same."""
    content = dict(pairs)
    if len(content) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        raise _TwiceError(_shortened(repr(next(name for name, count in counts.items() if count > 1))))
    return content


def _whole_number(text: str) -> int | float:
    """Without Python's refusal of thousands of digits."""
    return int(text) if len(text) <= MOST_DIGITS else float(text)


def write_json(content: dict[str, object], path: Path) -> None:
    """Write a JSON object, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


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

    def must_be(self, name: str, *wanted: str) -> str:
        """The text, which must be one of those wanted."""
        text = self.text(name)
        if text not in wanted:
            raise self.fail(name, f"is {text!r}, but must be {' or '.join(map(repr, wanted))}")
        return text

    def only(self, *known: str) -> None:
        """Refuse fields that nobody reads: they are misspelt more often than not."""
        for name in self._content:
            if name not in known:
                raise self.fail(name, f"is not a known field; known here are {', '.join(known)}")

    def names(self) -> list[str]:
        """Those of all fields, which must not be empty."""
        if "" in self._content:
            raise CaptureError(f"{self._path}: {self._prefix} has an entry with an empty name; give it one")
        return list(self._content)

    def text(self, name: str, default: str | None = None) -> str:
        """`default`, if there is one, where the field is missing or empty."""
        if default is not None and not self._content.get(name):
            return default
        value = self._get(name)
        if not isinstance(value, str) or not value:
            raise self.fail(name, f"is {_kind(value)}, but must be a non-empty string")
        if len(value) > MOST_CHARACTERS:
            raise self.fail(name, f"has {len(value)} characters, but must have at most {MOST_CHARACTERS}")
        return value

    def length_unit(self) -> str:
        """That of the file, which stands in names and labels."""
        unit = self.text("length_unit")
        if len(unit) > MOST_OF_A_UNIT:
            raise self.fail("length_unit", f"is {_kind(unit)}, but must have at most {MOST_OF_A_UNIT} characters")
        return unit

    def number(self, name: str) -> float:
        return self._number(name, self._get(name))

    def flag(self, name: str) -> bool:
        value = self._content.get(name)
        if not isinstance(value, bool):
            found = _kind(value) if isinstance(value, dict | list) else repr(value)
            raise self.fail(name, f"is {found}, but must be true or false")
        return value

    def positive(self, name: str, at_most: float) -> float:
        """A number above 0."""
        return self._positive(name, self.number(name), at_most)

    def positives(self, name: str, count: int, at_most: float) -> list[float]:
        """So many numbers above 0, or one for all of them."""
        if not self.is_list(name):
            return [self.positive(name, at_most)] * count
        values = enumerate(self.numbers(name, count))
        return [self._positive(f"{name}[{i}]", value, at_most) for i, value in values]

    def integer(self, name: str) -> int:
        value = self._get(name)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.fail(name, f"is {_kind(value)}, but must be a whole number")
        return value

    def numbers(self, name: str, *counts: int) -> list[float]:
        """A list of as many numbers as one of `counts` says."""
        value = self._get(name)
        if not isinstance(value, list) or len(value) not in counts:
            raise self.fail(name, f"is {_kind(value)}, but must be a list of {' or '.join(map(str, counts))} numbers")
        return [self._number(f"{name}[{i}]", item) for i, item in enumerate(value)]

    def number_list(self, name: str) -> list[float]:
        """One number or more."""
        value = self._get(name)
        if not isinstance(value, list) or not value:
            raise self.fail(name, f"is {_kind(value)}, but must be a list of numbers")
        return self.numbers(name, len(value))

    def is_list(self, name: str) -> bool:
        return isinstance(self._get(name), list)

    def texts(self, name: str) -> list[str]:
        """A list of texts."""
        value = self._get(name)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.fail(name, f"is {_kind(value)}, but must be a list of texts")
        return value

    def matrix(self, name: str) -> list[list[float]]:
        """A 3x3 matrix as three rows."""
        value = self._get(name)
        if not isinstance(value, list) or len(value) != 3:
            raise self.fail(name, f"is {_kind(value)}, but must be 3 rows of 3 numbers")
        return self.rows(name, 3)

    def rows(self, name: str, width: int) -> list[list[float]]:
        """A list of rows of `width` numbers."""
        value = self._get(name)
        if not isinstance(value, list):
            raise self.fail(name, f"is {_kind(value)}, but must be a list of lists of {width} numbers")
        if len(value) > MOST_OBJECTS:
            raise self.fail(name, f"lists {len(value)}, but must list at most {MOST_OBJECTS}")
        rows = Fields({f"{name}[{i}]": row for i, row in enumerate(value)}, self._path, self._prefix)
        return [rows.numbers(f"{name}[{i}]", width) for i in range(len(value))]

    def rotation(self, name: str) -> list[list[float]]:
        """A matrix whose rows are orthonormal and right-handed, to three digits."""
        return self.as_rotation(name, self.matrix(name))

    def as_rotation(self, name: str, rows: list[list[float]]) -> list[list[float]]:
        """The 3x3 matrix that is, or is a part of, a field, if it is a rotation."""
        errors = [
            sum(a * b for a, b in zip(rows[i], rows[j], strict=True)) - (i == j) for i in range(3) for j in range(3)
        ]
        (a, b, c), (d, e, f), (g, h, i) = rows
        turn = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
        if not (all(abs(error) <= OFF_A_ROTATION for error in errors) and turn > 0.0):
            raise self.fail(
                name, f"is {rows}, but must be a rotation: rows of length 1, square to each other, right-handed"
            )
        return rows

    def position(self, name: str) -> list[float]:
        """Three coordinates."""
        coordinates = self.numbers(name, 3)
        for i, coordinate in enumerate(coordinates):
            if abs(coordinate) > FARTHEST:
                raise self.fail(
                    f"{name}[{i}]", f"is {coordinate:g}, but must lie between -{FARTHEST:g} and {FARTHEST:g}"
                )
        return coordinates

    def object(self, name: str) -> "Fields":
        return Fields(self._get(name), self._path, self._label(name))

    def objects(self, name: str) -> "list[Fields]":
        value = self._get(name)
        if not isinstance(value, list):
            raise self.fail(name, f"is {_kind(value)}, but must be a list of objects")
        if len(value) > MOST_OBJECTS:
            raise self.fail(name, f"lists {len(value)}, but must list at most {MOST_OBJECTS}; split it into several")
        return [Fields(item, self._path, f"{self._label(name)}[{i}]") for i, item in enumerate(value)]

    def members(self, name: str) -> "dict[str, Fields]":
        """The objects in object `name`, by their names; none where it is missing."""
        if name not in self:
            return {}
        table = self.object(name)
        return {key: table.object(key) for key in table.names()}

    def _positive(self, name: str, value: float, at_most: float) -> float:
        if not 0.0 < value <= at_most:
            raise self.fail(name, f"is {value:g}, but must be above 0 and at most {at_most:g}")
        return value

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
        return f"{self._prefix}.{_shortened(name)}" if self._prefix else _shortened(name)


def _kind(value: Any) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return json.dumps(value) if isinstance(value, bool | None) else _shortened(repr(value))


def _shortened(text: str) -> str:
    """As much of a text as fits into a sentence."""
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}... ({len(text)} characters)"


def different_names(images: Sequence[Fields]) -> tuple[str, ...]:
    """Those of images, which must differ."""
    names: dict[str, None] = {}
    for image in images:
        name = image.text("name")
        if name in names:
            raise image.fail("name", f"is {name!r}, which an image before it already has; names must differ")
        names[name] = None
    return tuple(names)


@contextmanager
def scene_fields(path: Path) -> Generator[Fields]:
    """A JSON object that belongs to a scene; whatever is wrong with the file or its fields is raised as SceneError."""
    if not path.is_file():
        raise SceneError(f"{path} is not a file, but must be one of JSON")
    try:
        yield read_json(path, most=MOST_MEGABYTES_OF_A_SCENE)
    except CaptureError as error:
        raise SceneError(str(error)) from None
