"""What is known of photographs together: their own word, that of a table, and that of the user."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchrefrac.files.metadata.attitude import Attitude
from torchrefrac.files.metadata.photograph import Photograph
from torchrefrac.files.metadata.placing import Place
from torchrefrac.files.metadata.position import Vertical
from torchrefrac.files.metadata.table import Row

LEAST_DOWN = 1e-6  # of the third component of gravity; captures refuse 0
SKY = "it looks at the horizon or above by its gravity"


@dataclass(frozen=True)
class Gathered:
    """A photograph with what was chosen: attitude, where it was taken and by whose word, stated height in m, camera."""

    photograph: Photograph
    name: str
    attitude: Attitude | None
    place: Place | None
    place_source: str
    height: float | None
    camera: str

    @property
    def looks_up(self) -> bool:
        return self.attitude is not None and self.attitude.down_in_cam[2] < LEAST_DOWN


def gather(
    photographs: Sequence[Photograph],
    names: Sequence[str],
    rows: Sequence[Row | None],
    cameras: Sequence[str],
    gravity_sigma_deg: float | None = None,
    position_sigma: tuple[float, float] | None = None,
) -> list[Gathered]:
    """A table goes before the file; the sigmas given before both."""
    gathered = []
    for photograph, name, row, camera in zip(photographs, names, rows, cameras, strict=True):
        stated = row or Row(name)
        attitude = stated.attitude or photograph.attitude
        if attitude is not None and gravity_sigma_deg is not None:
            attitude = replace(attitude, sigma_deg=gravity_sigma_deg)
        place, source = _place(photograph, stated)
        if place is not None and position_sigma is not None:
            place = replace(place, sigma=position_sigma)
        gathered.append(Gathered(photograph, name, attitude, place, source, stated.height, stated.camera or camera))
    return gathered


def relative_names(paths: Sequence[Path], folder: Path) -> list[str]:
    """Names of photographs below a folder, with slashes."""
    return [path.relative_to(folder).as_posix() for path in paths]


def _place(photograph: Photograph, row: Row) -> tuple[Place | None, str]:
    fix = photograph.fix
    if row.degrees is not None or row.point is not None:
        altitudes = {} if fix is None else dict(fix.altitudes)
        if row.altitude is not None:
            altitudes = {Vertical.TABLE: row.altitude}
        sigma = row.sigma or (fix.sigma if fix is not None else (1.5, 3.0))
        return Place(row.degrees, row.point, altitudes, sigma), "table"
    if fix is None:
        return None, ""
    altitudes = fix.altitudes if row.altitude is None else {**fix.altitudes, Vertical.TABLE: row.altitude}
    return Place((fix.latitude, fix.longitude), None, altitudes, row.sigma or fix.sigma), fix.source
