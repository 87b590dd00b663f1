"""The cameras of a run beside its photographs, as programs that learn radiance fields read them."""

from pathlib import Path
from typing import Any

from torchrefrac.commands.densify import open_run
from torchrefrac.commands.results import require_replaceable, write_export_record
from torchrefrac.config.clouds import ExportOptions
from torchrefrac.config.options import OptionError
from torchrefrac.dense.images import photographs
from torchrefrac.files.cameras import POINTS, write_points
from torchrefrac.files.colmap.model import STEMS, write_colmap
from torchrefrac.files.masks import IMAGES, MASKS, Masks
from torchrefrac.files.paths import real_path
from torchrefrac.files.swap import alone
from torchrefrac.files.transforms import TRANSFORMS, write_transforms
from torchrefrac.files.water import WATER, write_water
from torchrefrac.scene import Capture, Scene

SPARSE = "sparse/0"


def export_training_set(options: ExportOptions) -> dict[str, Any]:
    """Write the registered cameras of a run, its points, links to its photographs and masks, and water.json into the
    folder `out`; returns what metrics.json there says.

    "nerfstudio": transforms.json; "gsplat": a COLMAP model in sparse/0. Both are in the frame of the run, and know no
    water: `load_cameras` takes it from water.json. Raises OptionError, SceneError, CaptureError or OutRefusedError.
    """
    whole = open_run(Path(options.run), options.capture).scene
    scene, folder = whole.of_views(whole.views.registered), Path(options.out)
    capture = photographs(scene)
    links, masks = {IMAGES: _folder_of(capture)}, _masks_of(capture)
    if masks:
        links[MASKS] = capture.folder / MASKS
    models = [TRANSFORMS, POINTS] if options.format == "nerfstudio" else [f"{SPARSE}/{stem}.bin" for stem in STEMS]
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        require_replaceable(folder, "export", (*models, *links, WATER))
        _write(scene, options, folder, masks)
        for name, place in links.items():
            (folder / name).unlink(missing_ok=True)
            (folder / name).symlink_to(real_path(place), target_is_directory=True)
        write_water(scene, folder / WATER)
        known = {"images": len(scene.views), "length_unit": scene.length_unit}
        return write_export_record(folder, options.run, options.format, [*models, *links, WATER], known)


def _write(scene: Scene, options: ExportOptions, folder: Path, masks: dict[str, str]) -> None:
    if options.format == "nerfstudio":
        write_points(scene.points[scene.placed], scene.colors[scene.placed], folder / POINTS)
        write_transforms(scene, folder / TRANSFORMS, IMAGES, masks or None, POINTS)
        return
    (folder / SPARSE).mkdir(parents=True, exist_ok=True)
    write_colmap(scene, folder / SPARSE, binary=True)


def _folder_of(capture: Capture) -> Path:
    """That in which the photographs have their names."""
    folder = capture.photographs_folder
    for path, name in zip(capture.paths, capture.names, strict=True):
        if folder / name != path:
            raise OptionError(f"photograph {name} does not lie in {folder}, as others do; put all into one folder")
    return folder


def _masks_of(capture: Capture) -> dict[str, str]:
    """The path of the mask of each photograph from the folder of the capture; of none where some have no mask."""
    found = {name: path for name, path in zip(capture.names, Masks(capture).paths, strict=True) if path is not None}
    whole = len(found) == len(capture.names)
    return {name: path.relative_to(capture.folder).as_posix() for name, path in found.items()} if whole else {}
