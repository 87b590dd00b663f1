"""PLY, binary of either byte order or text: fields are further properties of the vertices (float)."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from torchrefrac.atomic import replacing
from torchrefrac.files.clouds.cloud import CHUNK, Change, CloudError, free_names
from torchrefrac.files.clouds.rows import TextRows
from torchrefrac.files.ply import DenseFileError, PlyHeader, read_header, require_whole

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class PlyCloud:
    """A file whose first element are its vertices; what stands behind them is copied."""

    path: Path
    header: PlyHeader
    crs: str | None = None

    @classmethod
    def open(cls, path: Path) -> "PlyCloud":
        """Read the header. Raises CloudError."""
        try:
            header = read_header(path)
            if not header.is_text:
                require_whole(header, path)
        except DenseFileError as error:
            raise CloudError(str(error)) from None
        lacking = [name for name in AXES if name not in (header.vertex.names or ())]
        if lacking:
            raise CloudError(f"{path} has no property {lacking[0]} of its vertices, but must have x, y and z")
        return cls(path, header)

    @property
    def count(self) -> int:
        return self.header.count

    def rewrite(self, target: Path, change: Change, fields: Mapping[str, str]) -> None:
        names = free_names(fields, self.header.vertex.names or ())
        with self.path.open("rb") as source, replacing(target) as temporary, temporary.open("wb") as file:
            source.seek(self.header.start)
            file.write(self._header_with(tuple(names.values())))
            for start in range(0, self.count, CHUNK):
                size = min(CHUNK, self.count - start)
                if self.header.is_text:
                    self._rewrite_text(source, file, size, change)
                else:
                    self._rewrite_numbers(source, file, size, change, names)
            shutil.copyfileobj(source, file)

    def _header_with(self, names: tuple[str, ...]) -> bytes:
        """The header with more properties of the vertices, which are the first element."""
        lines = list(self.header.lines)
        at = [i for i, line in enumerate(lines) if line.split()[:1] == ["element"]][1:2] or [len(lines)]
        lines[at[0] : at[0]] = [f"property float {name}" for name in names]
        return "\n".join([*lines, "end_header", ""]).encode("utf-8")

    def _rewrite_numbers(
        self, source: BinaryIO, file: BinaryIO, size: int, change: Change, names: Mapping[str, str]
    ) -> None:
        given = np.fromfile(source, dtype=self.header.vertex, count=size)
        changed = change(torch.from_numpy(np.stack([given[name] for name in AXES], axis=-1).astype(np.float64)))
        written = np.empty(
            size, dtype=[*self.header.vertex.descr, *((name, f"{self.header.order}f4") for name in names.values())]
        )
        for name in self.header.vertex.names or ():
            written[name] = given[name]
        moved = changed.moved.numpy()
        for axis, name in enumerate(AXES):
            written[name][moved] = changed.coordinates.numpy()[moved, axis]
        for name, values in changed.fields.items():
            written[names[name]] = values.numpy()
        written.tofile(file)

    def _rewrite_text(self, source: BinaryIO, file: BinaryIO, size: int, change: Change) -> None:
        lines = [line.decode("utf-8") for line in islice(source, size)]
        columns = [(self.header.vertex.names or ()).index(name) for name in AXES]
        rows = TextRows(lines, None, columns, self.path)
        if len(rows) < size:
            raise CloudError(f"{self.path} is damaged: it ends before the last of its {self.count} vertices")
        file.writelines(line.encode("utf-8") for line in rows.rewritten(change, "nan"))
