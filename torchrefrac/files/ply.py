"""PLY files of points and triangles: binary, one record of plain numbers a vertex, read and written without a loop."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.checks import TorchrefracError

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
NAMES: dict[str, str] = dict(
    zip(KINDS, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double"), strict=True)
)
NEWER_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
TYPES = {name: kind for kind, name in (*NAMES.items(), *zip(KINDS, NEWER_NAMES, strict=True))}
FORMATS = {"format binary_little_endian 1.0": "<", "format binary_big_endian 1.0": ">", "format ascii 1.0": ""}
"""Byte order of the numbers; none where they are text."""
TRIANGLE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
LONGEST_HEADER = 1 << 16
FLOAT_STEPS = 1e6  # a float32 of this many standard deviations is rounded by 0.06 of one at most
FLOAT_SPREADS = 100.0  # a float32 of this many spreads of all points is rounded by 6e-6 of one at most


class DenseFileError(TorchrefracError, ValueError):
    """A file of a dense reconstruction is damaged or of another kind; the message names the file."""


def kind_of_coordinates(points: Float[Tensor, "n 3"], sigma: Float[Tensor, " m"] | None = None) -> str:
    """NumPy type of coordinates: float32 unless that rounds by more than a part of the standard deviations, of these
    points or of others like them, or, where none is known, of the spread of the points."""
    if not len(points):
        return "f4"
    exact = points.new_zeros(0) if sigma is None else sigma[(sigma > 0.0) & sigma.isfinite()]
    if len(exact):
        finest = FLOAT_STEPS * float(exact.median())
    else:
        finest = FLOAT_SPREADS * float((points - points.median(dim=0).values).norm(dim=-1).median())
    return "f8" if float(points.abs().max()) > finest else "f4"


def write_vertices(
    columns: Sequence[tuple[str, str, Shaped[Tensor, " n"]]],
    path: Path,
    comments: Sequence[str] = (),
    faces: Int[Tensor, "f 3"] | None = None,
) -> None:
    """Write the vertices of a binary little-endian PLY file, and the triangles between them, if there are any.

    columns: name, NumPy type ("f4", "u1", ...) and values of each property, in the order of the file. comments:
    lines of the header. faces: the vertices of each triangle. Raises ValueError where a comment has more than one line.
    """
    for comment in comments:
        if comment.splitlines() != [comment]:
            raise ValueError(f"the comment {comment!r} of {path} has a line break, but must be one line")
    vertices = np.empty(len(columns[0][2]), dtype=[(name, f"<{kind}") for name, kind, _ in columns])
    for name, _, values in columns:
        vertices[name] = values.detach().cpu().numpy()
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    header += [f"element vertex {len(vertices)}", *(f"property {NAMES[kind]} {name}" for name, kind, _ in columns)]
    triangles = np.empty(0 if faces is None else len(faces), dtype=TRIANGLE)
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles["count"], triangles["corners"] = 3, faces.detach().cpu().numpy()
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("utf-8"))
        vertices.tofile(file)
        triangles.tofile(file)


@dataclass(frozen=True)
class PlyHeader:
    """What a PLY file says of itself: its lines, the record of a vertex, how many there are and where they begin.

    order: "<" or ">", the order of the bytes of numbers, or nothing where they are text. ends_here: whether vertices
    are all there is.
    """

    lines: tuple[str, ...]
    vertex: np.dtype
    count: int
    start: int
    order: str
    ends_here: bool

    @property
    def is_text(self) -> bool:
        return not self.order

    @property
    def comments(self) -> tuple[str, ...]:
        return tuple(line.removeprefix("comment").strip() for line in self.lines if line.startswith("comment"))


def read_vertices(path: Path, mapped: bool = False) -> tuple[Shaped[np.ndarray, " n"], tuple[str, ...]]:
    """The vertices of a binary PLY file, a structured array with a field for each property, and its comments.

    mapped: the array stays in the file, and what is looked at is read. Elements behind the vertices (faces) are passed
    over. Raises DenseFileError where the file is missing, is no binary PLY file, has a list among the properties of its
    vertices, or holds fewer bytes than its header says (or, where the vertices are all it has, more).
    """
    header = read_header(path)
    if header.is_text:
        raise DenseFileError(f"{path} is not a binary PLY file of version 1.0; write it as binary_little_endian")
    require_whole(header, path)
    if mapped and header.count:
        in_file = np.memmap(path, dtype=header.vertex, mode="r", offset=header.start, shape=(header.count,))
        return in_file, header.comments
    with path.open("rb") as file:
        file.seek(header.start)
        return np.fromfile(file, dtype=header.vertex, count=header.count), header.comments


def require_whole(header: PlyHeader, path: Path) -> None:
    """Raise DenseFileError where a binary PLY file does not hold the vertices that its header promises."""
    size, wanted = path.stat().st_size - header.start, header.count * header.vertex.itemsize
    if size < wanted or (header.ends_here and size > wanted):
        raise DenseFileError(
            f"{path} is damaged: it has {size} bytes behind its header, but {header.count} vertices take {wanted}"
        )


def read_header(path: Path) -> PlyHeader:
    """The header of a PLY file of version 1.0 that begins with its vertices. Raises DenseFileError where the file is
    missing or is none, or a property of a vertex is a list."""
    try:
        with path.open("rb") as file:
            start = file.read(LONGEST_HEADER)
    except OSError as error:
        raise DenseFileError(f"{path} cannot be read: {error.strerror}") from None
    end = start.find(b"\nend_header")
    end_of_line = start.find(b"\n", end + 1)
    if not start.startswith((b"ply\n", b"ply\r\n")) or end < 0 or end_of_line < 0:
        raise DenseFileError(f"{path} is not a PLY file: it has no header from 'ply' to 'end_header'")
    try:
        lines = tuple(start[:end].decode("utf-8").splitlines())
    except UnicodeDecodeError:
        raise DenseFileError(f"{path} is damaged: its header is not text") from None
    order = next((FORMATS[line.strip()] for line in lines if line.strip() in FORMATS), None)
    if order is None:
        raise DenseFileError(f"{path} is not a binary PLY file of version 1.0; write it as binary_little_endian")
    elements: list[list[str]] = []
    fields: list[tuple[str, str]] = []
    for line in lines:
        match line.split():
            case ["element", *words]:
                elements.append(words)
            case ["property", kind, name] if len(elements) == 1 and kind in TYPES:
                fields.append((name, order + TYPES[kind]))
            case ["property", *_] if len(elements) == 1:
                raise DenseFileError(f"{path}: {line.strip()!r} is not a property of one number, as vertices must have")
            case _:
                pass
    name, count = elements[0] if elements and len(elements[0]) == 2 else ("", "")
    if name != "vertex" or not count.isdecimal() or not fields or len(dict(fields)) != len(fields):
        wanted = "'element vertex' and its number, and properties of different names"
        raise DenseFileError(f"{path} must begin with {wanted}")
    return PlyHeader(lines, np.dtype(fields), int(count), end_of_line + 1, order, len(elements) == 1)
