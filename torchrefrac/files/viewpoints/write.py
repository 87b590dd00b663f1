"""Cameras as tables of text that other programs read."""

import csv
from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.files.metadata.attitude import Mount, angles_of
from torchrefrac.files.viewpoints.table import POSITION, YPR
from torchrefrac.geometry.photogrammetric import angles_of_rotation
from torchrefrac.scene import Viewpoints

LENGTH, ANGLE = "{:.9g}", "{:.9f}"
SIGMAS = tuple(f"sigma_{name}" for name in POSITION)


def write_angles(viewpoints: Viewpoints, path: Path) -> None:
    """Name, position, omega, phi and kappa in degrees, parted by tabs, as Metashape writes them."""
    assert viewpoints.rotation is not None
    angles = angles_of_rotation(viewpoints.rotation).rad2deg().tolist()
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"# Cameras ({len(viewpoints)})\n# PhotoID, X, Y, Z, Omega, Phi, Kappa\n")
        for name, center, turn in zip(viewpoints.names, viewpoints.center.tolist(), angles, strict=True):
            file.write("\t".join((name, *map(_length, center), *map(ANGLE.format, turn))) + "\n")


def write_orientations(viewpoints: Viewpoints, path: Path, sigma: Float[Tensor, "m 3"] | None = None) -> None:
    """A CSV file of names, positions, yaw, pitch and roll in degrees (see `table`), and standard deviations of the
    positions where they are known."""
    assert viewpoints.rotation is not None
    turns = [angle.rad2deg().tolist() for angle in angles_of(viewpoints.rotation, Mount.DOWN)]
    columns: Sequence[Sequence[float]] = [] if sigma is None else sigma.T.tolist()
    titles = ("name", *POSITION, *YPR, *(SIGMAS if columns else ()))
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(titles)
        for name, center, *rest in zip(viewpoints.names, viewpoints.center.tolist(), *turns, *columns, strict=True):
            angles, sigmas = rest[:3], rest[3:]
            table.writerow([name, *map(_length, center), *map(ANGLE.format, angles), *map(LENGTH.format, sigmas)])


def _length(value: float) -> str:
    """To a ten-thousandth of a millimetre, in metres; more digits have no meaning."""
    return f"{value:.7f}"
