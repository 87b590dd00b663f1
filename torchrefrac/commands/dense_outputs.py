"""What the dense stage leaves in a run folder."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrefrac.config import DenseOutputs
from torchrefrac.dense import Dense, DenseOptions, depth_maps
from torchrefrac.figures.dense import dense_view, draw_dense_views, draw_depth_map, draw_error_map, error_panel
from torchrefrac.figures.profiles import draw_profiles
from torchrefrac.figures.raster import draw_raster
from torchrefrac.figures.surface_view import draw_surface_view
from torchrefrac.files.dense import write_dense, write_depth_map
from torchrefrac.files.mesh import height_field_mesh, write_mesh
from torchrefrac.files.raster import write_raster
from torchrefrac.files.run import DENSE_CLOUD, DENSE_RESULTS, DENSE_VIEW, DEPTH_MAPS, ERROR_MAP, PROFILES, SURFACE_VIEW
from torchrefrac.files.swap import remove_if_empty
from torchrefrac.geometry import Similarity
from torchrefrac.recorder import Recorder
from torchrefrac.scene import DenseCloud, Raster, Scene, Truth
from torchrefrac.scene.wording import Wording, wording_of


def write_dense_outputs(cloud: DenseCloud, raster: Raster | None, outputs: DenseOutputs, folder: Path) -> None:
    """Write dense.ply, and what is asked for of the surface on a grid."""
    if raster is not None:
        if outputs.raster:
            write_raster(raster, folder)
        if outputs.mesh:
            write_mesh(height_field_mesh(raster), folder / "mesh.ply", raster.sigma[raster.valid])
    write_dense(cloud, folder / DENSE_CLOUD)


def draw_dense_outputs(
    cloud: DenseCloud,
    raster: Raster | None,
    scene: Scene,
    truth: Truth | None,
    alignment: Similarity | None,
    metrics: Mapping[str, Any],
    folder: Path,
) -> None:
    """The surface from above (where there is a raster), from aside, as it looks and, where it is known, against the
    truth."""
    words = wording_of(scene, metrics)
    if raster is not None:
        draw_raster(raster, folder / "dsm.png", words)
        draw_profiles(raster, folder / PROFILES, words)
    model = metrics.get("model") or ("refractive" if scene.index_ratio > 1.0 else "none")
    known = truth if alignment is not None else None
    draw_dense_views([dense_view(model, cloud, scene, alignment, metrics)], known, folder / DENSE_VIEW)
    draw_surface_view(cloud, alignment, known, wording_of(scene, metrics, known is not None), folder / SURFACE_VIEW)
    if truth is not None and alignment is not None and len(truth.corner):
        panel = error_panel(model, cloud, alignment, truth, metrics, wording_of(scene, metrics, upright=True))
        draw_error_map([panel], truth, folder / ERROR_MAP)


def write_depth_maps(
    dense: Dense, scene: Scene, options: DenseOptions, words: Wording, recorder: Recorder, folder: Path
) -> None:
    """Write and draw what every registered view sees of the surface."""
    stems, count = depth_map_stems(scene.views.names), scene.views.num_registered
    for found in recorder.track(depth_maps(dense, scene, options), count, "depth maps", "image"):
        write_depth_map(found, folder / f"{stems[found.name]}_depth.npz")
        draw_depth_map(found, folder / f"{stems[found.name]}_depth.png", words)


def remove_dense_outputs(folder: Path) -> None:
    """Remove what a dense stage has finished in a run folder; the parts of an unfinished one stay."""
    for name in DENSE_RESULTS:
        (folder / name).unlink(missing_ok=True)
    for path in depth_map_files(folder):
        path.unlink()
        remove_if_empty(path.parent, folder)


def depth_map_files(folder: Path) -> list[Path]:
    """The depth maps in a run folder, and their pictures."""
    return [path for end in ("npz", "png") for path in (folder / DEPTH_MAPS).rglob(f"*_depth.{end}")]


def depth_map_stems(names: Sequence[str]) -> dict[str, str]:
    """For each image the path of its depth map, without "_depth" and ending: its name without its own ending, which it
    keeps where another image has the same name but for that."""
    stems = {name: str(Path(name).with_suffix("")) for name in names}
    times = Counter(stems.values())
    return {name: stem if times[stem] == 1 else name for name, stem in stems.items()}
