"""CSV: x, y and z by the names of columns in the first line; fields are further columns."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from torchrefrac.atomic import replacing
from torchrefrac.files.clouds.cloud import CHUNK, Change, CloudError, free_names
from torchrefrac.files.clouds.rows import TextRows

ENCODING, ERRORS = "utf-8-sig", "surrogateescape"
ALIASES = {
    "x": ("x", "east", "easting"), "y": ("y", "north", "northing"), "z": ("z", "height", "elevation", "sfm_z"),
}  # fmt: skip


@dataclass(frozen=True)
class TableCloud:
    """A file with names of columns in its first line, parted by commas, semicolons, tabs or blanks."""

    path: Path
    count: int
    head: str
    separator: str | None
    columns: tuple[int, int, int]
    crs: str | None = None

    @classmethod
    def open(cls, path: Path) -> "TableCloud":
        """Read the first line, and count the others. Raises CloudError."""
        try:
            with path.open(encoding=ENCODING, errors=ERRORS) as file:
                head = file.readline().rstrip("\r\n")
            with path.open("rb") as file:
                count = sum(1 for line in file if line.strip()) - 1
        except OSError as error:
            raise CloudError(f"{path} cannot be read: {error.strerror}") from None
        most = max(",;\t", key=head.count)
        separator = most if most in head else None
        plain = [name.strip().strip('"').lower() for name in head.lstrip("/# ").split(separator)]
        found = {axis: [i for i, name in enumerate(plain) if name in names] for axis, names in ALIASES.items()}
        lacking = [axis for axis, places in found.items() if not places]
        if lacking:
            raise CloudError(f"{path} has no column called {lacking[0]}; its first line must name x, y and z")
        x, y, z = (places[0] for places in found.values())
        return cls(path, max(count, 0), head, separator, (x, y, z))

    def rewrite(self, target: Path, change: Change, fields: Mapping[str, str]) -> None:
        between, unknown = (" ", "nan") if self.separator is None else (self.separator, "")
        taken = (name.strip().strip('"') for name in self.head.split(self.separator))
        names = free_names(fields, taken)
        with (
            self.path.open(encoding=ENCODING, errors=ERRORS) as source,
            replacing(target) as temporary,
            temporary.open("w", encoding="utf-8", errors=ERRORS, newline="") as file,
        ):
            source.readline()
            file.write(between.join((self.head, *names.values())) + "\n")
            while lines := list(islice(source, CHUNK)):
                file.writelines(TextRows(lines, self.separator, self.columns, self.path).rewritten(change, unknown))
