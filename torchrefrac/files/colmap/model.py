"""Reading and writing a COLMAP model: cameras, images and points3D, as text or binary files."""

from contextlib import ExitStack
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.files.colmap.assembly import assemble, tables_of
from torchrefrac.files.colmap.binary import (
    read_cameras_bin,
    read_images_bin,
    read_points_bin,
    write_cameras_bin,
    write_images_bin,
    write_points_bin,
)
from torchrefrac.files.colmap.text import (
    read_cameras_txt,
    read_images_txt,
    read_points_txt,
    write_cameras_txt,
    write_images_txt,
    write_points_txt,
)
from torchrefrac.scene import Scene, SceneError

STEMS = ("cameras", "images", "points3D")
NEWER_STEMS = ("rigs", "frames")
SUBFOLDERS = (".", "sparse/0", "sparse")


def find_colmap(folder: Path) -> tuple[Path, str] | None:
    """The folder of a whole model in `folder`, its sparse/0 or its sparse, and the ending of its files: .bin before
    .txt."""
    for place in (folder / name for name in SUBFOLDERS):
        for ending in (".bin", ".txt"):
            if all((place / f"{stem}{ending}").is_file() for stem in STEMS):
                return place, ending
    return None


def read_colmap(folder: str | Path) -> Scene:
    """Read the COLMAP model in `folder`, `folder`/sparse/0 or `folder`/sparse; binary files before text files.

    Images, cameras and points are put in the order of their ids; cameras that no image has are left out, and so are
    features without a point. Observations of a point are in the order of its track; of several in one image the first
    stays, and a point that fewer than two images see is dropped. The frame is the model's own, the length unit "unit"
    and the index ratio 1: a model knows no water. rigs and frames files (COLMAP 3.12 writes them) are not needed.

    Raises SceneError, with the file and the line or record, where a file is missing, truncated or inconsistent, has
    a number that is not finite, a quaternion of zero length, or a camera model other than SIMPLE_PINHOLE, PINHOLE,
    SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV (with k4, k5 and k6 of 0).
    """
    folder = Path(folder)
    found = find_colmap(folder)
    if found is None:
        raise SceneError(_what_is_missing(folder))
    place, ending = found
    paths = [place / f"{stem}{ending}" for stem in STEMS]
    if ending == ".bin":
        tables = read_cameras_bin(paths[0]), read_images_bin(paths[1]), read_points_bin(paths[2])
    else:
        tables = read_cameras_txt(paths[0]), read_images_txt(paths[1]), read_points_txt(paths[2])
    return assemble(*tables, *paths)


def write_colmap(
    scene: Scene, folder: str | Path, binary: bool = False, errors: Float[Tensor, "..."] | None = None
) -> None:
    """Write cameras, images and points3D of a finished scene, as text or binary files; ids count from 1 in the order of
    its cameras, registered views and points. Its water has no place in them.

    `errors`: the reprojection error of each point in pixels, which the files have a place for; -1 (unknown) by default.
    Intrinsics become a PINHOLE camera where the distortion is zero, OPENCV where k3 is, else FULL_OPENCV. All numbers
    survive to the last bit except poses, which the files hold as quaternion and translation: 1e-15 or so. The files
    replace those of an earlier model only once all three are complete. Raises SceneError where `folder` holds files
    that whoever reads the model would take for a part of it, and for a name that the files cannot keep.
    """
    folder, ending = Path(folder), ".bin" if binary else ".txt"
    others = [f"{stem}{'.txt' if binary else '.bin'}" for stem in STEMS]
    others += [f"{stem}{kind}" for stem in NEWER_STEMS for kind in (".bin", ".txt")]
    stale = [name for name in others if (folder / name).exists()]
    if stale:
        raise SceneError(f"{folder} holds {', '.join(stale)} of another model; give an empty folder, or remove them")
    cameras, images, points = tables_of(scene, errors)
    for name in images.names:
        if not name or "\0" in name:
            raise SceneError(f"an image has the name {name!r}, which a COLMAP model cannot keep; rename it")
    write_cameras = write_cameras_bin if binary else write_cameras_txt
    write_images = write_images_bin if binary else write_images_txt
    write_points = write_points_bin if binary else write_points_txt
    with ExitStack() as stack:
        paths = [stack.enter_context(replacing(folder / f"{stem}{ending}")) for stem in STEMS]
        write_cameras(cameras, paths[0])
        write_images(images, paths[1])
        write_points(points, paths[2])


def _what_is_missing(folder: Path) -> str:
    if not folder.is_dir():
        return f"{folder} is not a folder; give the one that holds the files of a COLMAP model"
    for place in (folder / name for name in SUBFOLDERS):
        for ending in (".bin", ".txt"):
            has = {stem: (place / f"{stem}{ending}").is_file() for stem in STEMS}
            if has["cameras"] or has["images"] or has["points3D"]:
                missing = " and ".join(f"{stem}{ending}" for stem, there in has.items() if not there)
                return f"{place} lacks {missing}, without which a COLMAP model is not whole; export the model again"
    return (
        f"{folder} holds no COLMAP model: looked for cameras, images and points3D (.bin or .txt) in it and in its "
        "sparse/0 and sparse; give the folder that holds them"
    )
