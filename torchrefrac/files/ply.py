"""PLY files of points and triangles: binary, one record of plain numbers a vertex, read and written without a loop."""

from collections.abc import Sequence
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
BYTE_ORDERS = {"format binary_little_endian 1.0": "<", "format binary_big_endian 1.0": ">"}
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


def read_vertices(path: Path, mapped: bool = False) -> tuple[Shaped[np.ndarray, " n"], tuple[str, ...]]:
    """The vertices of a binary PLY file, a structured array with a field for each property, and its comments.

    mapped: the array stays in the file, and what is looked at is read. Elements behind the vertices (faces) are passed
    over. Raises DenseFileError where the file is missing, is no binary PLY file, has a list among the properties of its
    vertices, or holds fewer bytes than its header says (or, where the vertices are all it has, more).
    """
    try:
        with path.open("rb") as file:
            start = file.read(LONGEST_HEADER)
            dtype, count, comments, offset, ends_here = _header(start, path)
            file.seek(0, 2)
            size, wanted = file.tell() - offset, count * dtype.itemsize
            if size < wanted or (ends_here and size > wanted):
                raise DenseFileError(
                    f"{path} is damaged: it has {size} bytes behind its header, but {count} vertices take {wanted}"
                )
            if mapped and count:
                return np.memmap(path, dtype=dtype, mode="r", offset=offset, shape=(count,)), comments
            file.seek(offset)
            return np.fromfile(file, dtype=dtype, count=count), comments
    except OSError as error:
        raise DenseFileError(f"{path} cannot be read: {error.strerror}") from None


def _header(start: bytes, path: Path) -> tuple[np.dtype, int, tuple[str, ...], int, bool]:
    """Record, number of vertices, comments, where the vertices begin, and whether they are all there is."""
    end = start.find(b"\nend_header")
    end_of_line = start.find(b"\n", end + 1)
    if not start.startswith((b"ply\n", b"ply\r\n")) or end < 0 or end_of_line < 0:
        raise DenseFileError(f"{path} is not a PLY file: it has no header from 'ply' to 'end_header'")
    try:
        lines = start[:end].decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise DenseFileError(f"{path} is damaged: its header is not text") from None
    order = next((BYTE_ORDERS[line.strip()] for line in lines if line.strip() in BYTE_ORDERS), None)
    if order is None:
        raise DenseFileError(f"{path} is not a binary PLY file of version 1.0; write it as binary_little_endian")
    comments = tuple(line.removeprefix("comment").strip() for line in lines if line.startswith("comment"))
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
    return np.dtype(fields), int(count), comments, end_of_line + 1, len(elements) == 1
