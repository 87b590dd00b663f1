"""Files of a dense reconstruction: its points as PLY, what each image sees as a NumPy archive."""

import mmap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int, Shaped
from torch import Tensor

from torchrefrac.files.npz import read_arrays, write_arrays
from torchrefrac.files.ply import DenseFileError, kind_of_coordinates, read_vertices, write_vertices
from torchrefrac.scene.dense import DenseCloud, DepthMap

DEPTH_MAP_FORMAT = "torchrefrac-depth-map/1"
GRIDS = {"points": "n:hw3", "depth": "n:hw", "sigma": "n:hw", "valid": "b:hw"}
DEPTH_MAP = {"name": "U:", "step": "i:", **GRIDS, "length_unit": "U:"}
POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
AXES, COMMON = ("sigma_x", "sigma_y", "sigma_z"), "sigma_common"
UNIT = "length_unit"
MOST_VIEWS = 65535
READ = 8192
"""Points of a file that are read at once: each may lie on a page of its own, and others are read with that."""


def write_dense(cloud: DenseCloud, path: str | Path) -> None:
    """Write a dense cloud as binary PLY: x y z nx ny nz red green blue views sigma sigma_relative sigma_x sigma_y
    sigma_z sigma_common score reference of every vertex.

    Numbers are float32, colours uchar, views ushort (at most 65535), reference int32; the unit of length is a comment
    of the header. Coordinates are float64 where one is more than a million times the median sigma, which float32 would
    round away.
    """
    kind = kind_of_coordinates(cloud.points, cloud.sigma)
    triples = ((POSITION, kind, cloud.points), (NORMAL, "f4", cloud.normals), (COLOR, "u1", cloud.colors))
    columns = [(name, k, column) for names, k, of in triples for name, column in zip(names, of.T, strict=True)]
    columns += [("views", "u2", cloud.views.clamp(max=MOST_VIEWS)), ("sigma", "f4", cloud.sigma)]
    columns += [("sigma_relative", "f4", cloud.relative_sigma)]
    axes = zip(AXES, cloud.axis_sigma.T, strict=True)
    columns += [*((name, "f4", along) for name, along in axes), (COMMON, "f4", cloud.common_sigma)]
    columns += [("score", "f4", cloud.score), ("reference", "i4", cloud.reference)]
    write_vertices(columns, Path(path), comments=(f"{UNIT} {cloud.length_unit}",))


def load_dense(path: str | Path) -> DenseCloud:
    """Read what `write_dense` wrote; its properties may stand in any order, among others and in any number type.

    Raises DenseFileError, which names the file, where it is missing or damaged, no binary PLY file, lacks a property or
    the comment with the unit of length, or has a coordinate that is not finite.
    """
    path = Path(path)
    vertices, comments = read_vertices(path)
    cloud = _cloud(vertices, _unit(vertices, comments, path))
    if not cloud.points.isfinite().all():
        raise DenseFileError(f"{path} is damaged: it has a coordinate that is not finite")
    return cloud


class DenseFile:
    """A dense cloud that stays in its file: of its points, those that are asked for are read.

    Raises what `load_dense` raises, but for coordinates that are not finite.
    """

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        self._vertices, comments = read_vertices(path, mapped=True)
        self.length_unit = _unit(self._vertices, comments, path)

    def __len__(self) -> int:
        return len(self._vertices)

    def __getitem__(self, rows: Int[Tensor, " k"]) -> DenseCloud:
        found, pages = np.empty(len(rows), dtype=self._vertices.dtype), getattr(self._vertices, "_mmap", None)
        for start in range(0, len(rows), READ):
            found[start : start + READ] = self._vertices[rows[start : start + READ].numpy()]
            if pages is not None and hasattr(mmap, "MADV_DONTNEED"):
                pages.madvise(mmap.MADV_DONTNEED)  # else what was read of the file counts as memory of the process
        return _cloud(found, self.length_unit)


def _unit(vertices: Shaped[np.ndarray, " n"], comments: Sequence[str], path: Path) -> str:
    """The unit of length. Raises DenseFileError where there is none, or a property is missing."""
    wanted = (*POSITION, *NORMAL, *COLOR, "views", "sigma", "score", "reference")
    missing = [name for name in wanted if name not in (vertices.dtype.names or ())]
    if missing:
        raise DenseFileError(f"{path} is not a dense cloud: its vertices lack {', '.join(missing)}")
    units = [comment.removeprefix(UNIT).strip() for comment in comments if comment.startswith(f"{UNIT} ")]
    if not units:
        raise DenseFileError(f"{path} is not a dense cloud: its header lacks the comment '{UNIT} ...'")
    return units[0]


def _cloud(vertices: Shaped[np.ndarray, " n"], unit: str) -> DenseCloud:
    def columns(names: Sequence[str], dtype: type = np.float64) -> Shaped[Tensor, "n k"]:
        return torch.from_numpy(np.stack([vertices[name].astype(dtype) for name in names], axis=-1))

    known = vertices.dtype.names or ()
    relative = "sigma_relative" if "sigma_relative" in known else "sigma"
    of_axes = {"axis_sigma": columns(AXES), "common_sigma": columns((COMMON,))[:, 0]} if COMMON in known else {}
    return DenseCloud(
        points=columns(POSITION),
        normals=columns(NORMAL),
        colors=columns(COLOR, np.uint8),
        **{name: columns((name,))[:, 0] for name in ("sigma", "score")},
        **{name: columns((name,), np.int64)[:, 0] for name in ("views", "reference")},
        relative_sigma=columns((relative,))[:, 0],
        length_unit=unit,
        **of_axes,
    )


def write_depth_map(depth_map: DepthMap, path: str | Path) -> None:
    """Write a depth map as a NumPy archive: points, depth, sigma (float32), valid, step, name and length_unit.

    Points are float64 where `write_dense` would make them so.
    """
    valid = depth_map.valid
    kinds = {"points": kind_of_coordinates(depth_map.points[valid], depth_map.sigma[valid]), "valid": "?"}
    arrays = {"format": np.array(DEPTH_MAP_FORMAT)}
    for name in DEPTH_MAP:
        value = getattr(depth_map, name)
        is_grid = name in GRIDS
        arrays[name] = value.detach().cpu().numpy().astype(kinds.get(name, "f4")) if is_grid else np.array(value)
    write_arrays(arrays, path)


def load_depth_map(path: str | Path) -> DepthMap:
    """Read what `write_depth_map` wrote, float64 again. Raises DenseFileError where the file is missing or damaged."""
    found = read_arrays(path, DEPTH_MAP, DenseFileError, DEPTH_MAP_FORMAT)
    return DepthMap(
        name=str(found["name"]),
        step=int(found["step"]),
        **{name: torch.from_numpy(found[name]) for name in GRIDS},
        length_unit=str(found["length_unit"]),
    )
