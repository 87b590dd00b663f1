"""The binary files of a COLMAP model: little-endian records of variable length behind a count."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchrefrac.files.colmap import tables
from torchrefrac.files.colmap.tables import AGAIN, CameraRow, ImageTable, PointTable
from torchrefrac.scene import SceneError

COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
FEATURE = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<i8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")])
LENGTH_AT = POINT.itemsize - COUNT.size
ELEMENT = np.dtype([("image", "<u4"), ("feature", "<u4")])


class _Records:
    """The records of one file, and where the reading stands."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self.kind = path, kind
        self.data = path.read_bytes()
        self.offset = self.record = 0
        if len(self.data) < COUNT.size:
            raise SceneError(f"{path} is truncated before its first record; {AGAIN}")
        (self.count,) = self.take(COUNT)

    def __iter__(self) -> Iterator[int]:
        for record in range(self.count):
            self.record = record
            yield record
        left = len(self.data) - self.offset
        if left:
            raise SceneError(f"{self.path} has {left} bytes after the last of its {self.count} {self.kind}; {AGAIN}")

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        return layout.unpack_from(self.data, self.skip(layout.size))

    def skip(self, size: int) -> int:
        """Where the next `size` bytes begin."""
        start = self.offset
        if size > len(self.data) - start:
            raise self.truncated()
        self.offset += size
        return start

    def text(self) -> str:
        """Up to the next zero byte."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.truncated()
        raw = self.data[self.skip(end + 1 - self.offset) : end]
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            problem = f"record {self.record} has the name {raw!r}, which is not UTF-8; rename the image"
            raise SceneError(f"{self.path}: {problem}") from None

    def truncated(self) -> SceneError:
        where = f"within record {self.record} of {self.count} {self.kind}"
        return SceneError(f"{self.path} is truncated: it ends {where}; {AGAIN}")


def read_cameras(path: Path) -> list[CameraRow]:
    """Read cameras.bin."""
    records = _Records(path, "cameras")
    rows = []
    for _ in records:
        camera, number, width, height = records.take(CAMERA)
        model = tables.MODELS.get(number) or tables.OTHER_MODELS.get(number) or f"number {number}"
        parameters = records.take(struct.Struct(f"<{tables.parameter_count(model, camera, path)}d"))
        rows.append(CameraRow(camera, model, width, height, parameters))
    return rows


def read_images(path: Path) -> ImageTable:
    """Read images.bin."""
    records = _Records(path, "images")
    heads, names, features = [], [], [np.zeros(0, dtype=FEATURE)]
    for _ in records:
        heads.append(records.take(IMAGE))
        names.append(records.text())
        (count,) = records.take(COUNT)
        features.append(np.frombuffer(records.data, FEATURE, count, records.skip(count * FEATURE.itemsize)))
    poses = np.array([head[1:8] for head in heads], dtype=np.float64).reshape(-1, 7)
    table = np.concatenate(features)
    return ImageTable(
        names=tuple(names),
        ids=np.array([head[0] for head in heads], dtype=np.int64),
        quaternions=poses[:, :4],
        translations=poses[:, 4:],
        cameras=np.array([head[8] for head in heads], dtype=np.int64),
        starts=np.cumsum([len(rows) for rows in features]),
        pixels=table["pixel"],
        points=table["point"],
    )


def read_points(path: Path) -> PointTable:
    """Read points3D.bin."""
    records = _Records(path, "points")
    starts, length_of, data, end = [], COUNT.unpack_from, records.data, len(records.data)
    for _ in records:
        start = records.offset
        starts.append(start)
        after = start + POINT.itemsize
        if after > end:
            raise records.truncated()
        records.skip(POINT.itemsize + ELEMENT.itemsize * length_of(data, start + LENGTH_AT)[0])
    content = np.frombuffer(data, dtype=np.uint8)
    at = np.array(starts, dtype=np.int64)[:, None] + np.arange(POINT.itemsize)
    heads = content[at].view(POINT)[:, 0] if starts else np.zeros(0, dtype=POINT)
    is_track = np.ones(len(content), dtype=bool)
    is_track[: COUNT.size] = False
    is_track[at] = False
    elements = content[is_track].view(ELEMENT)
    return PointTable(
        ids=heads["id"],
        positions=heads["position"],
        colors=heads["color"],
        errors=heads["error"],
        lengths=heads["length"].astype(np.int64),
        images=elements["image"].astype(np.int64),
        features=elements["feature"].astype(np.int64),
    )


def write_cameras(rows: list[CameraRow], path: Path) -> None:
    """Write cameras.bin."""
    with path.open("wb") as file:
        file.write(COUNT.pack(len(rows)))
        for row in rows:
            file.write(CAMERA.pack(row.id, tables.MODEL_IDS[row.model], row.width, row.height))
            file.write(struct.pack(f"<{len(row.parameters)}d", *row.parameters))


def write_images(table: ImageTable, path: Path) -> None:
    """Write images.bin."""
    features = np.empty(len(table.points), dtype=FEATURE)
    features["pixel"], features["point"] = table.pixels, table.points
    with path.open("wb") as file:
        file.write(COUNT.pack(len(table.names)))
        for i, name in enumerate(table.names):
            pose = (*table.quaternions[i].tolist(), *table.translations[i].tolist())
            rows = features[table.starts[i] : table.starts[i + 1]]
            file.write(IMAGE.pack(table.ids[i], *pose, table.cameras[i]))
            file.write(name.encode("utf-8") + b"\0" + COUNT.pack(len(rows)))
            file.write(rows.tobytes())


def write_points(table: PointTable, path: Path) -> None:
    """Write points3D.bin."""
    heads = np.empty(len(table.ids), dtype=POINT)
    heads["id"], heads["position"], heads["color"] = table.ids, table.positions, table.colors
    heads["error"], heads["length"] = table.errors, table.lengths
    elements = np.empty(len(table.images), dtype=ELEMENT)
    elements["image"], elements["feature"] = table.images, table.features
    head_bytes, track_bytes = heads.tobytes(), elements.tobytes()
    ends = (np.cumsum(table.lengths) * ELEMENT.itemsize).tolist()
    with path.open("wb") as file:
        file.write(COUNT.pack(len(heads)))
        start = 0
        for i, end in enumerate(ends):
            file.write(head_bytes[i * POINT.itemsize : (i + 1) * POINT.itemsize])
            file.write(track_bytes[start:end])
            start = end
