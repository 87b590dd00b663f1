"""`tracks.npz`: the tie points of a run beside its `cameras.json`; the two together are an alignment."""

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.files.cameras import FORMAT
from torchrefrac.files.colmap.model import find_colmap, read_colmap
from torchrefrac.files.fields import Fields, alignment_errors, read_object
from torchrefrac.scene.alignment import Alignment, AlignmentError
from torchrefrac.scene.reconstruction import Reconstruction

CAMERAS, TRACKS = "cameras.json", "tracks.npz"
ARRAYS = {
    "image": (np.int64, 1),
    "point": (np.int64, 1),
    "pixels": (np.float64, 2),
    "points": (np.float64, 2),
    "colors": (np.uint8, 2),
}


def write_tracks(scene: Reconstruction | Alignment, path: str | Path) -> None:
    """Write points (n, 3), their colors (n, 3) uint8, the observations image (N), point (N) and pixels (N, 2), and the
    names (m) that `image` counts, as a NumPy archive."""
    arrays = {name: getattr(scene, name).detach().cpu().numpy() for name in ARRAYS}
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez(file, names=np.array(scene.names, dtype=np.str_), **arrays)


def read_alignment(folder: str | Path) -> Alignment:
    """Read the run (`read_run`) or the COLMAP model (`read_colmap`) in `folder`: a run where it holds cameras.json and
    tracks.npz. Raises AlignmentError, and says what it looked for, where there is neither."""
    folder = Path(folder)
    if not folder.is_dir():
        raise AlignmentError(f"{folder} is not a folder; give that of a run or of a COLMAP model")
    has = {name: (folder / name).is_file() for name in (CAMERAS, TRACKS)}
    if all(has.values()):
        return read_run(folder)
    if find_colmap(folder) is not None:
        return read_colmap(folder)
    if any(has.values()):
        return read_run(folder)
    try:
        return read_colmap(folder)
    except AlignmentError as error:
        raise AlignmentError(f"{folder} holds no run: looked for {CAMERAS} and {TRACKS}; {error}") from None


def read_run(folder: str | Path) -> Alignment:
    """Read the registered images and their tie points from cameras.json and tracks.npz in the folder of a run.

    Points that fewer than two registered images see are left out. The frame is that of the run: z up, the water surface
    at z = 0. Raises AlignmentError, with the file and the field, for anything that cannot be right.
    """
    folder = Path(folder)
    for name in (CAMERAS, TRACKS):
        if not (folder / name).is_file():
            raise AlignmentError(
                f"{folder} holds no {name}, which a run has; reconstruct again, or name its run folder"
            )
    with alignment_errors():
        content, top = read_object(folder / CAMERAS)
        lens, unit = _lens(top), top.text("length_unit")
        poses = _poses(top, content)
    path = folder / TRACKS
    names, arrays = _arrays(path)
    for name, pose in poses.items():
        if pose is not None and name not in names:
            raise AlignmentError(f"{path} lacks {name}, which {CAMERAS} has registered; take both from one run")
    identity = (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    placed = [poses.get(name) or identity for name in names]
    try:
        everything = Alignment(
            names=names,
            lenses=(lens,),
            lens=torch.zeros(len(names), dtype=torch.long),
            rotation=torch.stack([rotation for rotation, _ in placed]),
            center=torch.stack([center for _, center in placed]),
            length_unit=unit,
            **arrays,
        )
    except AlignmentError as error:
        raise AlignmentError(f"{path}: {error}") from None
    for i in everything.image.unique().tolist():
        if names[i] not in poses:
            raise AlignmentError(
                f"{path} has observations in {names[i]}, which {CAMERAS} lacks; take both from one run"
            )
    return everything.of_images(torch.tensor([poses.get(name) is not None for name in names])).cleaned()


def _lens(top: Fields) -> Intrinsics:
    for name, wanted in (("format", FORMAT), ("pixel_origin", "corner")):
        if top.text(name) != wanted:
            raise top.fail(name, f"is {top.text(name)!r}, but must be {wanted!r}")
    fields = top.object("intrinsics")
    for name in ("width", "height", "fx", "fy"):
        if fields.number(name) <= 0:
            raise fields.fail(name, f"is {fields.number(name):g}, but must be above 0")
    return Intrinsics.create(
        fields.integer("width"),
        fields.integer("height"),
        focal=(fields.number("fx"), fields.number("fy")),
        principal_point=(fields.number("cx"), fields.number("cy")),
        distortion=fields.numbers("distortion", 5),
    )


def _poses(top: Fields, content: dict[str, Any]) -> dict[str, tuple[Tensor, Tensor] | None]:
    """cam_from_world rotation (3, 3) and centre (3) of each image; None where it is not registered."""
    poses: dict[str, tuple[Tensor, Tensor] | None] = {}
    for image, plain in zip(top.objects("images"), content["images"], strict=True):
        name, registered = image.text("name"), plain.get("registered")
        if not isinstance(registered, bool):
            raise image.fail("registered", f"is {registered!r}, but must be true or false")
        if name in poses:
            raise image.fail("name", f"is {name!r}, which an image before it already has; names must differ")
        poses[name] = None
        if registered:
            rotation = torch.tensor(image.matrix("cam_from_world_rotation"), dtype=torch.float64)
            poses[name] = (rotation, torch.tensor(image.numbers("center_in_world", 3), dtype=torch.float64))
    return poses


def _arrays(path: Path) -> tuple[tuple[str, ...], dict[str, Tensor]]:
    """The content of `tracks.npz`, checked; point ascending."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            found = {name: archive[name] for name in ("names", *ARRAYS) if name in archive}
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise AlignmentError(f"{path} is not a whole NumPy archive: {error}; reconstruct again") from None
    missing = [name for name in ("names", *ARRAYS) if name not in found]
    if missing:
        raise AlignmentError(f"{path} lacks {', '.join(missing)}; reconstruct again")
    names = found["names"]
    if names.dtype.kind != "U" or names.ndim != 1 or len(set(names.tolist())) != len(names) or not len(names):
        raise AlignmentError(f"{path}: names must be a list of different texts, at least one; reconstruct again")
    arrays = {}
    for name, (dtype, dimensions) in ARRAYS.items():
        value = found[name]
        if not np.can_cast(value.dtype, dtype, "safe") or value.ndim != dimensions:
            raise AlignmentError(
                f"{path}: {name} is {value.dtype} with {value.ndim} dimensions, but must be {np.dtype(dtype)} with "
                f"{dimensions}; reconstruct again"
            )
        if not np.isfinite(value).all():
            raise AlignmentError(f"{path}: {name} has a number that is not finite; reconstruct again")
        arrays[name] = torch.from_numpy(value.astype(dtype))
    return tuple(names.tolist()), arrays
