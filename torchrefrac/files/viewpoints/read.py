"""Cameras of any source: a run, a COLMAP model, Metashape's XML, or a table."""

from pathlib import Path

import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.files.tracks import read_scene
from torchrefrac.files.viewpoints.metashape import read_metashape
from torchrefrac.files.viewpoints.table import read_table
from torchrefrac.scene import Cameras, Scene, SceneError, Viewpoints, field_of_view


def read_viewpoints(path: Path, lens: Intrinsics | None = None, crs: str | None = None) -> Viewpoints:
    """The cameras in the folder of a run or of a COLMAP model, in an XML file of Metashape, or in a table of text.

    lens: of all photographs of a table, which knows none. crs: the reference system of what they look at, where it is
    known: cameras of a run, or of Metashape, that stand on Earth come in it. Raises SceneError, with the file, for
    anything that cannot be right, and for a lens beside one that a file states.
    """
    if path.is_dir() or path.suffix.lower() == ".xml":
        if lens is not None:
            raise SceneError(f"{path} has calibrated cameras; leave out camera, focal_px and size")
        return viewpoints_of(read_scene(path), crs) if path.is_dir() else read_metashape(path, crs)
    found = read_table(path)
    if lens is None or found.rotation is None:
        return found
    one = torch.zeros(len(found), dtype=torch.long)
    return Viewpoints(found.names, found.center, found.rotation, field_of_view(Cameras.of([lens]), one))


def viewpoints_of(scene: Scene, crs: str | None = None) -> Viewpoints:
    """Of the registered views of a scene; on the map where it says where it stands and `crs` asks for it."""
    scene = scene.of_views(scene.views.registered)
    views, place = scene.views, scene.georeference
    field = field_of_view(scene.cameras, views.camera)
    if place is None or crs is None:
        return Viewpoints(views.names, views.center, views.rotation, field)
    rotation = views.rotation @ place.level_from_local.mT
    return Viewpoints(views.names, place.coordinates(views.center), rotation, field, place.name)
