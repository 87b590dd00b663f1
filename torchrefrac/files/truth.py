"""`truth.json`: where a scene was made, the true cameras, planes and surface; `truth_points.npz` beside it: the true
surface point of every few pixels. For evaluation only."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.files.capture import read_capture_cameras
from torchrefrac.files.extent import read_extent
from torchrefrac.files.fields import Fields, read_json
from torchrefrac.files.interface import INTERFACE, read_interfaces
from torchrefrac.files.intrinsics import camera_of_images
from torchrefrac.files.npz import read_arrays
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.scene import CaptureError, Truth, TruthPoints

POINTS_FILE = "truth_points.npz"
CENTER_OF_FIRST_PIXEL = 0.5  # the file counts from the centre of the first pixel, OpenCV's convention


def load_truth(folder: str | Path, with_surface: bool = True) -> Truth | None:
    """Read `folder`/truth.json; None where there is none.

    The interface is that of truth.json, or else, as always the intrinsics, that of the capture.json beside it, if
    there is one; intrinsics that are uncertain there are not known. `surface` names a file of triangles beside it that
    trimesh can read; it is left out unless with_surface. Raises CaptureError where a file is damaged, or the one of the
    surface is missing.
    """
    folder = Path(folder)
    path = folder / "truth.json"
    if not path.is_file():
        return None
    top = read_json(path)
    images = top.objects("images")
    planes = top.objects("planes") if "planes" in top else []
    capture = read_json(folder / "capture.json") if (folder / "capture.json").is_file() else None
    ratio_from = top if "index_ratio" in top or INTERFACE in top else capture

    def table(rows: list[list[float]]) -> Float[Tensor, "n 3"]:
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)

    names = tuple(image.text("name") for image in images)
    return Truth(
        names=names,
        rotation=torch.tensor([image.rotation("cam_from_world_rotation") for image in images], dtype=torch.float64),
        center=table([image.position("center_in_world") for image in images]),
        corner=table([plane.position("origin") for plane in planes]),
        edge1=table([plane.position("e1") for plane in planes]),
        edge2=table([plane.position("e2") for plane in planes]),
        length_unit=top.length_unit(),
        interfaces=None if ratio_from is None else read_interfaces(ratio_from),
        intrinsics=None if capture is None else _intrinsics(capture, names),
        folder=folder,
        water_extent=read_extent(top),
        surface=_read_surface(top, folder) if with_surface and "surface" in top else None,
    )


def _intrinsics(capture: Fields, names: Sequence[str]) -> Intrinsics | None:
    """Of the photographs `names`: those that capture.json states, where it has no doubt of them."""
    cameras = read_capture_cameras(capture)
    if cameras.are_uncertain:
        return None
    images = capture.objects("images")
    rows = dict(zip((image.text("name") for image in images), camera_of_images(images, cameras), strict=True))
    return cameras.of_views(torch.tensor([rows.get(name, 0) for name in names]), coefficients=5)


def load_truth_points(folder: Path, names: Sequence[str]) -> TruthPoints | None:
    """Read `folder`/truth_points.npz; None where there is none.

    The images of the file are those of truth.json, in its order. The result has those that `names` lists, in the order
    of `names`; a name that truth.json does not have is left out. In the file, X (m, h, w, 3) holds the points, NaN
    where there is none, plane (m, h, w) the indices of their planes, and the scalars step and offset say at which pixel
    an entry was taken, counted from the centre of the first pixel. Raises CaptureError where one of the files is
    damaged, or the two do not fit together.
    """
    path = folder / POINTS_FILE
    if not path.is_file():
        return None
    truth = load_truth(folder, with_surface=False)
    if truth is None:
        raise CaptureError(f"{folder / 'truth.json'} does not exist, but names the images of {path}")
    found = read_arrays(path, {"X": "f:mhw3", "plane": "i:mhw", "step": "i:", "offset": "n:"}, CaptureError)
    points, plane, step = found["X"], found["plane"], int(found["step"])
    if step < 1:
        raise CaptureError(f"{path}: step is {step}, but must be a whole number of pixels, 1 at least")
    if len(points) != len(truth.names):
        raise CaptureError(f"{path}: X is of {len(points)} images, but truth.json has {len(truth.names)}")
    if plane.size and plane.max() >= max(len(truth.corner), 1):
        raise CaptureError(f"{path}: plane has {plane.max()}, but truth.json has {len(truth.corner)} planes")
    known = [name for name in names if name in truth.names]
    rows = [truth.names.index(name) for name in known]
    chosen = torch.from_numpy(points[rows].astype(np.float64))
    valid = chosen.isfinite().all(dim=-1)
    return TruthPoints(
        names=tuple(known),
        step=step,
        offset=float(found["offset"]) + CENTER_OF_FIRST_PIXEL,
        points=torch.where(valid[..., None], chosen, 0.0),
        plane=torch.from_numpy(plane[rows]),
        valid=valid,
    )


def _read_surface(top: Fields, folder: Path) -> TriangleMesh:
    import trimesh  # noqa: PLC0415 - slow to import, needed only where there is a mesh

    name = top.text("surface")
    path = folder / name
    if Path(name).name != name or not path.is_file():
        raise top.fail("surface", f"is {name!r}, but must name a file of triangles beside truth.json")
    try:
        mesh = trimesh.load(path, process=False)
    except (OSError, ValueError, KeyError, IndexError, TypeError, EOFError, NotImplementedError) as error:
        raise top.fail("surface", f"is {name!r}, which cannot be read: {error}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise top.fail("surface", f"is {name!r}, which holds no triangles")
    vertices, faces = torch.tensor(mesh.vertices, dtype=torch.float64), torch.tensor(mesh.faces, dtype=torch.long)
    if not bool(vertices.isfinite().all()):
        raise top.fail("surface", f"is {name!r}, which has vertices that are not finite")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise top.fail("surface", f"is {name!r}, which has triangles of vertices that it lacks")
    return TriangleMesh(vertices, faces)
