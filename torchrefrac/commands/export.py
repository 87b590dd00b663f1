"""The cameras of a run for other programs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.commands.densify import open_run
from torchrefrac.commands.results import MODEL, require_replaceable, write_export_record
from torchrefrac.commands.survey_products import require_place, require_surface, write_survey_products
from torchrefrac.commands.training_sets import export_training_set
from torchrefrac.config.clouds import TRAINING_SETS, ExportOptions
from torchrefrac.files.cameras import CAMERAS, read_cameras
from torchrefrac.files.colmap.model import STEMS, find_colmap, read_colmap, write_colmap
from torchrefrac.files.dense import DenseFile
from torchrefrac.files.run import DENSE_CLOUD, FOR_SURVEYS, RunRecord
from torchrefrac.files.swap import alone, settle
from torchrefrac.files.tracks import TRACKS, read_run
from torchrefrac.files.viewpoints import viewpoints_of, write_angles, write_orientations
from torchrefrac.files.water import WATER, with_water, write_water
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Georeference, Interfaces, Scene, SceneError
from torchrefrac.scene.interfaces import WALL

TABLES = {"opk": "cameras_opk.txt", "csv": "cameras.csv"}


def export_run(options: ExportOptions, recorder: Recorder | None = None) -> dict[str, Any]:
    """Write the registered cameras of a run, or of an adjustment, into the folder `out`, and water.json beside them, or
    the products of its dense surface, or a training set; returns what metrics.json there says.

    A COLMAP model is in the frame of the run, with its points; tables are on the map where the run says where it
    stands. Raises SceneError or OutRefusedError.
    """
    if options.format == "survey":
        return export_products(options, recorder or SilentRecorder())
    if options.format in TRAINING_SETS:
        return export_training_set(options)
    scene, folder = read_posed(Path(options.run)), Path(options.out)
    place = None if options.format == "colmap" else scene.georeference
    table = TABLES.get(options.format)
    files = [table] if table else [f"{stem}.txt" for stem in STEMS]
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        require_replaceable(folder, "export", (*files, WATER))
        if table is None:
            write_colmap(scene, folder)
        else:
            viewpoints = viewpoints_of(scene, None if place is None else place.name)
            covariance = scene.assessment.center_covariance
            if options.format == "opk":
                write_angles(viewpoints, folder / table)
            else:
                turn = torch.eye(3, dtype=torch.float64) if place is None else place.level_from_local
                along = None if covariance is None else (turn @ covariance @ turn.mT).diagonal(dim1=1, dim2=2)
                sigma = None if along is None else along.clamp(min=0.0).sqrt()
                write_orientations(viewpoints, folder / table, sigma)
        if place is not None:
            scene = replace(scene, interfaces=_on_map(scene, place))
        write_water(scene, folder / WATER)
        crs = {} if place is None else {"crs": place.name}
        known = {"images": len(scene.views), "length_unit": scene.length_unit, **crs}
        return write_export_record(folder, options.run, options.format, [*files, WATER], known)


def _on_map(scene: Scene, place: Georeference) -> Interfaces:
    """What a scene looks through, where its frame lies on the map; ports stay with their cameras."""
    interfaces = scene.interfaces
    if interfaces.move_with_camera:
        return interfaces
    if WALL not in interfaces.kinds:
        return Interfaces.of_plane(place.water, scene.index_ratio)
    stretched = interfaces.normal / interfaces.normal.new_tensor((place.scale, place.scale, 1.0))
    length = stretched.norm(dim=-1)
    offset = interfaces.offset + stretched @ stretched.new_tensor(place.origin)
    return replace(interfaces, normal=stretched / length[:, None], offset=offset / length)


def export_products(options: ExportOptions, recorder: Recorder) -> dict[str, Any]:
    """Write what a survey takes from the dense surface of a run, which stays in its file; returns what metrics.json
    there says. Raises OptionError, SceneError, CaptureError, DenseError or OutRefusedError."""
    run, folder = Path(options.run), Path(options.out)
    if not (run / DENSE_CLOUD).is_file():
        raise SceneError(f"{run} holds no {DENSE_CLOUD}: make it dense first, by torchrefrac densify run={run}")
    settle(run)
    needs_photographs = options.outputs.geotiff and options.outputs.orthophoto
    scene = open_run(run, options.capture).scene if needs_photographs else read_run(run)
    require_surface(scene.interfaces)
    require_place(options.outputs, scene.georeference)
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        require_replaceable(folder, "export", FOR_SURVEYS)
        known = write_survey_products(DenseFile(run / DENSE_CLOUD), scene, options.outputs, folder, recorder)
        files = [name for name in FOR_SURVEYS if (folder / name).is_file()]
        known = {"length_unit": scene.length_unit} | known
        return write_export_record(folder, options.run, options.format, files, known)


def read_posed(folder: Path) -> Scene:
    """Registered views, with their points where the folder has them."""
    if not folder.is_dir():
        raise SceneError(f"{folder} is not a folder, but run must be that of a run or of an adjustment")
    settle(folder)
    if (folder / CAMERAS).is_file():
        scene = read_run(folder) if (folder / TRACKS).is_file() else read_cameras(folder / CAMERAS)
        return scene.of_views(scene.views.registered)
    if find_colmap(folder / MODEL) is None or not (folder / WATER).is_file():
        raise SceneError(f"{folder} holds neither {CAMERAS} nor {MODEL}/ with {WATER}; name the folder of a run")
    scene = with_water(read_colmap(folder / MODEL), folder / WATER)
    return replace(scene, length_unit=RunRecord.read(folder).length_unit or scene.length_unit)
