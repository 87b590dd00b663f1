"""LAS and LAZ: fields are extra bytes (float32)."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from torchrefrac.atomic import replacing
from torchrefrac.files.clouds.cloud import CHUNK, Change, CloudError, free_names
from torchrefrac.files.las import MOST_STEPS, require_las


@dataclass(frozen=True)
class LasCloud:
    """A file of any version and point format that laspy reads."""

    path: Path
    count: int
    crs: str | None

    @classmethod
    def open(cls, path: Path) -> "LasCloud":
        """Read the header. Raises CloudError."""
        try:
            require_las()
        except ImportError as error:
            raise CloudError(f"{path}: {error}") from None
        with _opened(path) as file:
            return cls(path, file.header.point_count, _system(file.header))

    def rewrite(self, target: Path, change: Change, fields: Mapping[str, str]) -> None:
        import laspy  # noqa: PLC0415 - of an extra
        from laspy.vlrs.vlrlist import VLRList  # noqa: PLC0415

        with _opened(self.path) as source, replacing(target) as temporary:
            header = deepcopy(source.header)
            header.vlrs, appended = _general(source.header.vlrs), _general(source.evlrs or ())
            names = free_names(fields, header.point_format.dimension_names)
            extra = [laspy.ExtraBytesParams(names[name], "f4", description=what) for name, what in fields.items()]
            header.add_extra_dims(extra)
            with laspy.open(temporary, mode="w", header=header) as file:
                for given in source.chunk_iterator(CHUNK):
                    record: Any = laspy.ScaleAwarePointRecord.zeros(len(given), header=header)
                    for name in given.array.dtype.names:
                        record.array[name] = given.array[name]
                    coordinates = np.stack((given.x, given.y, given.z), axis=-1).astype(np.float64)
                    changed = change(torch.from_numpy(coordinates))
                    self._move(record.array, changed.coordinates.numpy(), changed.moved.numpy(), header)
                    for name, values in changed.fields.items():
                        record.array[names[name]] = values.numpy()
                    file.write_points(record)
                if appended:
                    file.write_evlrs(VLRList(appended))

    def _move(
        self, record: Any, coordinates: Float[np.ndarray, "n 3"], moved: Bool[np.ndarray, " n"], header: Any
    ) -> None:
        """Put points on the grid of whole numbers that the file has."""
        for axis, name in enumerate("XYZ"):
            steps = np.rint((coordinates[moved, axis] - header.offsets[axis]) / header.scales[axis])
            if len(steps) and np.abs(steps).max() > MOST_STEPS:
                raise CloudError(
                    f"{self.path} counts {name.lower()} in steps of {header.scales[axis]:g}, in which the corrected "
                    "points do not fit; write it with another offset or scale"
                )
            record[name][moved] = steps.astype(np.int32)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import laspy  # noqa: PLC0415 - of an extra
    from laspy.errors import LaspyException  # noqa: PLC0415
    from lazrs import LazrsError  # type: ignore[attr-defined]  # noqa: PLC0415

    try:
        with laspy.open(path) as file:
            yield file
    except (LaspyException, LazrsError, EOFError) as error:
        raise CloudError(f"{path} cannot be read as LAS: {' '.join(str(error).split())}") from None


def _general(records: Iterable[Any]) -> list[Any]:
    """Those that do not say where points lie in the file: a cloud optimised for the cloud (COPC) comes out as plain
    LAZ."""
    return [record for record in records if record.user_id.lower() != "copc"]


def _system(header: Any) -> str | None:
    from pyproj.exceptions import CRSError  # noqa: PLC0415 - of an extra

    try:
        system = header.parse_crs()
    except (CRSError, ValueError):
        return None
    return None if system is None else system.to_wkt()
