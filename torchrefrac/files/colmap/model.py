"""Reading and writing a COLMAP model: cameras, images and points3D, as text or binary files."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType

from jaxtyping import Float
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.files.colmap import binary as binary_files
from torchrefrac.files.colmap import text as text_files
from torchrefrac.files.colmap.assembly import assemble, tables_of
from torchrefrac.files.colmap.tables import AGAIN, Ids
from torchrefrac.scene import Scene, SceneError

STEMS = ("cameras", "images", "points3D")
NEWER_STEMS = ("rigs", "frames")
SUBFOLDERS = (".", "sparse/0", "sparse")


def find_colmap(folder: Path) -> tuple[Path, str] | None:
    """The folder of a whole model in `folder`, its sparse/0 or its sparse, and the ending of its files: .bin before
    .txt."""
    return next((found for found in _places(folder) if not _lacking(*found)), None)


def _places(folder: Path) -> Iterator[tuple[Path, str]]:
    """Where the files of a model may be, and how they end."""
    return ((folder / name, ending) for name in SUBFOLDERS for ending in (".bin", ".txt"))


def _lacking(place: Path, ending: str) -> list[str]:
    return [f"{stem}{ending}" for stem in STEMS if not (place / f"{stem}{ending}").is_file()]


def read_colmap(folder: str | Path) -> Scene:
    """Read the COLMAP model in `folder`, `folder`/sparse/0 or `folder`/sparse; binary files before text files.

    Images, cameras and points are put in the order of their ids; cameras that no image has are left out, and so are
    features without a point. Observations of a point are in the order of its track; of several in one image the first
    stays, and a point that fewer than two images see is dropped. The frame is the model's own, the length unit "unit"
    and the index ratio 1: a model knows no water. rigs and frames files (COLMAP 3.12 writes them) are not needed.

    Raises SceneError, with the file and the line or record, where a file is missing, truncated or inconsistent, has
    a number that is not finite, a quaternion of zero length, or a camera model other than SIMPLE_PINHOLE, PINHOLE,
    SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV and OPENCV_FISHEYE.
    """
    files, (cameras, images, points) = _files(Path(folder))
    tables = files.read_cameras(cameras), files.read_images(images), files.read_points(points)
    return assemble(*tables, cameras, images, points)


def read_ids(folder: str | Path) -> Ids:
    """What the model that `read_colmap` reads there calls its images and cameras. Raises the same."""
    files, (_, path, _) = _files(Path(folder))
    images = files.read_images(path)
    return Ids(dict(zip(images.names, images.ids.tolist(), strict=True)), tuple(sorted(set(images.cameras.tolist()))))


def write_colmap(
    scene: Scene,
    folder: str | Path,
    binary: bool = False,
    errors: Float[Tensor, "..."] | None = None,
    ids: Ids | None = None,
) -> None:
    """Write cameras, images and points3D of a finished scene, as text or binary files. Its water has no place in them.

    ids: of images and cameras, as in the model that the scene was read from; by default they count from 1, as those of
    points do, in the order of its cameras, registered views and points.
    `errors`: the reprojection error of each point in pixels, which the files have a place for; -1 (unknown) by default.
    Cameras keep the model that they were read as, where it holds their numbers; others become OPENCV_FISHEYE, PINHOLE
    where the distortion is zero, OPENCV where k3 is, else FULL_OPENCV. All numbers survive to the last bit except
    poses, which the files hold as quaternion and translation: 1e-15 or so. The files replace those of an earlier model
    only once all three are complete. Raises SceneError where `folder` holds files that whoever reads the model would
    take for a part of it, and for a name that the files cannot hold.
    """
    folder, ending = Path(folder), ".bin" if binary else ".txt"
    others = [f"{stem}{'.txt' if binary else '.bin'}" for stem in STEMS]
    others += [f"{stem}{kind}" for stem in NEWER_STEMS for kind in (".bin", ".txt")]
    stale = [name for name in others if (folder / name).exists()]
    if stale:
        raise SceneError(f"{folder} holds {', '.join(stale)} of another model; give an empty folder, or remove them")
    cameras, images, points = tables_of(scene, errors, ids)
    for name in images.names:
        if not name or "\0" in name:
            raise SceneError(f"an image has the name {name!r}, which a COLMAP model cannot hold; rename it")
    files = binary_files if binary else text_files
    with ExitStack() as stack:
        paths = [stack.enter_context(replacing(folder / f"{stem}{ending}")) for stem in STEMS]
        files.write_cameras(cameras, paths[0])
        files.write_images(images, paths[1])
        files.write_points(points, paths[2])


def _files(folder: Path) -> tuple[ModuleType, list[Path]]:
    """How the files of a model in a folder are read, and where they are, in the order of STEMS."""
    found = find_colmap(folder)
    if found is None:
        raise SceneError(_what_is_missing(folder))
    place, ending = found
    return binary_files if ending == ".bin" else text_files, [place / f"{stem}{ending}" for stem in STEMS]


def _what_is_missing(folder: Path) -> str:
    if not folder.is_dir():
        return f"{folder} is not a folder; give the one that holds the files of a COLMAP model"
    for place, ending in _places(folder):
        missing = _lacking(place, ending)
        if len(missing) < len(STEMS):
            return f"{place} lacks {' and '.join(missing)}, without which a COLMAP model is not whole; {AGAIN}"
    return (
        f"{folder} holds no COLMAP model: looked for cameras, images and points3D (.bin or .txt) in it and in its "
        "sparse/0 and sparse; give the folder that holds them"
    )
