"""The text files of a COLMAP model: one line a camera, two an image, one a point; # begins a comment."""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from torchrefrac.files.colmap.tables import AGAIN, CameraRow, ImageTable, PointTable, parameter_count
from torchrefrac.scene import SceneError

CAMERAS_HEAD = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
IMAGES_HEAD = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
POINTS_HEAD = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"


def read_cameras(path: Path) -> list[CameraRow]:
    """Read cameras.txt."""
    rows = []
    for number, line in _records(_lines(path)):
        words = line.split()
        with _numbers(path, number):
            _require_columns(len(words) >= 4, words, "CAMERA_ID MODEL WIDTH HEIGHT and parameters", path, number)
            camera, model = int(words[0]), words[1]
            count = parameter_count(model, camera, path)
            wanted = f"CAMERA_ID {model} WIDTH HEIGHT and {count} parameters"
            _require_columns(len(words) == 4 + count, words, wanted, path, number)
            rows.append(CameraRow(camera, model, int(words[2]), int(words[3]), tuple(map(float, words[4:]))))
    return rows


def read_images(path: Path) -> ImageTable:
    """Read images.txt. A name reaches to the end of its line, blanks and all."""
    names: list[str] = []
    ids: list[np.ndarray] = []  # of the image and of its camera
    poses: list[list[float]] = []
    pixels, points, starts = [np.zeros((0, 2))], [np.zeros(0, dtype=np.int64)], [0]
    lines = _lines(path)
    for number, line in _records(lines):
        words = line.split(maxsplit=9)
        with _numbers(path, number):
            wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            _require_columns(len(words) == 10, words, wanted, path, number)
            ids.append(np.array((int(words[0]), int(words[8])), dtype=np.int64))
            poses.append([float(word) for word in words[1:8]])
            names.append(words[9].rstrip())
        number, line = next(lines, (number + 1, ""))  # noqa: PLW2901 - the line of features belongs to the image
        words = line.split()
        with _numbers(path, number):
            _require_columns(len(words) % 3 == 0, words, "X Y POINT3D_ID of each feature", path, number)
            x, y, point = ([kind(word) for word in words[i::3]] for i, kind in enumerate((float, float, int)))
            pixels.append(np.array((x, y), dtype=np.float64).T)
            points.append(np.array(point, dtype=np.int64))
            starts.append(starts[-1] + len(point))
    whole = np.array(ids, dtype=np.int64).reshape(-1, 2)
    table = np.array(poses, dtype=np.float64).reshape(-1, 7)
    return ImageTable(
        names=tuple(names),
        ids=whole[:, 0],
        quaternions=table[:, :4],
        translations=table[:, 4:],
        cameras=whole[:, 1],
        starts=np.array(starts),
        pixels=np.concatenate(pixels),
        points=np.concatenate(points),
    )


def read_points(path: Path) -> PointTable:
    """Read points3D.txt."""
    ids: list[np.ndarray] = []
    numbers: list[list[float]] = []
    colors: list[list[int]] = []
    lengths: list[int] = []
    tracks = [np.zeros(0, dtype=np.int64)]
    for number, line in _records(_lines(path)):
        words = line.split()
        with _numbers(path, number):
            wanted = "POINT3D_ID X Y Z R G B ERROR and IMAGE_ID POINT2D_IDX of each observation"
            _require_columns(len(words) >= 8 and len(words) % 2 == 0, words, wanted, path, number)
            whole = np.array([int(word) for word in (words[0], *words[8:])], dtype=np.int64)
            ids.append(whole[0])
            tracks.append(whole[1:])
            numbers.append([float(words[i]) for i in (1, 2, 3, 7)])
            color = [int(word) for word in words[4:7]]
            if not 0 <= min(color) <= max(color) <= 255:
                raise SceneError(f"{path}, line {number}: colour {color} must lie in 0 to 255; correct it")
            colors.append(color)
            lengths.append(len(words) // 2 - 4)
    elements = np.concatenate(tracks)
    table = np.array(numbers, dtype=np.float64).reshape(-1, 4)
    return PointTable(
        ids=np.array(ids, dtype=np.int64),
        positions=table[:, :3],
        colors=np.array(colors, dtype=np.uint8).reshape(-1, 3),
        errors=table[:, 3],
        lengths=np.array(lengths, dtype=np.int64),
        images=elements[0::2],
        features=elements[1::2],
    )


def write_cameras(rows: list[CameraRow], path: Path) -> None:
    """Write cameras.txt; here and below, numbers have all the digits that set them apart from their neighbours."""
    lines = [f"{row.id} {row.model} {row.width} {row.height} {_join(row.parameters)}\n" for row in rows]
    path.write_text(CAMERAS_HEAD + "".join(lines), encoding="utf-8", newline="\n")


def write_images(table: ImageTable, path: Path) -> None:
    """Write images.txt. SceneError for a name that would not survive it."""
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(IMAGES_HEAD)
        for i, name in enumerate(table.names):
            if name.split() != [name]:
                raise SceneError(
                    f"{name!r} has a blank, at which COLMAP would cut the name in a text file; rename the image, or "
                    "write binary files"
                )
            pose = (*table.quaternions[i].tolist(), *table.translations[i].tolist())
            file.write(f"{table.ids[i]} {_join(pose)} {table.cameras[i]} {name}\n")
            rows = slice(table.starts[i], table.starts[i + 1])
            features = zip(table.pixels[rows].tolist(), table.points[rows].tolist(), strict=True)
            file.write(" ".join(f"{x!r} {y!r} {point}" for (x, y), point in features) + "\n")


def write_points(table: PointTable, path: Path) -> None:
    """Write points3D.txt."""
    tracks = np.stack((table.images, table.features), axis=-1).reshape(-1).tolist()
    ends = (2 * np.cumsum(table.lengths)).tolist()
    rows = zip(table.ids.tolist(), table.positions.tolist(), table.colors.tolist(), table.errors.tolist(), strict=True)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(POINTS_HEAD)
        start = 0
        for (point, position, color, error), end in zip(rows, ends, strict=True):
            file.write(f"{_join((point, *position, *color, error, *tracks[start:end]))}\n")
            start = end


def _join(numbers: tuple[float, ...]) -> str:
    return " ".join(map(repr, numbers))


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """All lines with their numbers, from 1, with or without a byte order mark before them."""
    with path.open(encoding="utf-8-sig") as file:
        try:
            yield from enumerate(file, start=1)
        except UnicodeDecodeError as error:
            raise SceneError(f"{path} is not UTF-8 text: {error}; {AGAIN}") from None


def _records(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Those that are neither blank nor a comment."""
    return ((number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#"))


def _require_columns(fits: bool, words: list[str], wanted: str, path: Path, number: int) -> None:
    if not fits:
        raise SceneError(f"{path}, line {number}: has {len(words)} columns, but must have {wanted}; {AGAIN}")


@contextmanager
def _numbers(path: Path, number: int) -> Generator[None]:
    """Name the line where a word is no number."""
    try:
        yield
    except SceneError:
        raise
    except (ValueError, OverflowError) as error:
        raise SceneError(f"{path}, line {number}: {error}; correct the line") from None
