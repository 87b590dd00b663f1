"""Points as lines of text."""

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.files.clouds.cloud import Change, CloudError

COORDINATE, FIELD = "{:.12g}", "{:.6g}"


class TextRows:
    """Lines of numbers and texts, parted by `separator` (None: by blanks), with x, y and z in some columns; lines of
    blanks are left out. Raises CloudError where a coordinate is no number."""

    def __init__(self, lines: Sequence[str], separator: str | None, columns: Sequence[int], path: Path) -> None:
        self._lines = [line.rstrip("\r\n") for line in lines if line.strip()]
        self._separator, self._columns, self._path = separator, tuple(columns), path

    def __len__(self) -> int:
        return len(self._lines)

    def coordinates(self) -> Float[Tensor, "n 3"]:
        """Of all points."""
        if not self._lines:
            return torch.zeros(0, 3, dtype=torch.float64)
        try:
            read = np.loadtxt(
                self._lines, delimiter=self._separator, usecols=self._columns, ndmin=2, comments=None, quotechar='"'
            )
        except ValueError as error:
            raise CloudError(f"{self._path} has coordinates that cannot be read: {error}") from None
        return torch.from_numpy(read)

    def rewritten(self, change: Change, unknown: str) -> Iterator[str]:
        """The lines with new coordinates where points moved, and with more fields at their ends; `unknown` stands for
        NaN."""
        changed = change(self.coordinates())
        between = self._separator or " "
        fields = zip(*(values.tolist() for values in changed.fields.values()), strict=True)
        rows = zip(self._lines, changed.coordinates.tolist(), changed.moved.tolist(), fields, strict=True)
        for line, coordinates, moved, more in rows:
            texts = [unknown if math.isnan(value) else FIELD.format(value) for value in more]
            start = self._moved(line, coordinates) if moved else line
            yield between.join((start, *texts)) + "\n"

    def _moved(self, line: str, coordinates: Sequence[float]) -> str:
        parts = self._parts(line)
        for column, value in zip(self._columns, coordinates, strict=True):
            parts[column] = COORDINATE.format(value)
        return (self._separator or " ").join(parts)

    def _parts(self, line: str) -> list[str]:
        """What stands in the columns, in its quotes where it has any."""
        if self._separator is None:
            return line.split()
        if '"' not in line:
            return line.split(self._separator)
        return [f'"{part}"' if self._separator in part else part
                for part in next(csv.reader([line], delimiter=self._separator))]  # fmt: skip
