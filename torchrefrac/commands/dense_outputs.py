"""What the dense stage leaves in a run folder."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from torchrefrac.config.outputs import DenseOutputs
from torchrefrac.dense import Dense, DenseError, DenseOptions, depth_maps
from torchrefrac.dense.rasterize import rasterize
from torchrefrac.figures.depth_map import draw_depth_map
from torchrefrac.figures.raster import draw_raster
from torchrefrac.files.dense import write_dense, write_depth_map
from torchrefrac.files.mesh import height_field_mesh, write_mesh
from torchrefrac.files.raster import write_geotiff, write_raster
from torchrefrac.files.run import DENSE_CLOUD, DENSE_RESULTS, DEPTH_MAPS
from torchrefrac.recorder import Recorder
from torchrefrac.scene import DenseCloud, Raster, Scene


def write_dense_outputs(
    dense: Dense,
    scene: Scene,
    options: DenseOptions,
    outputs: DenseOutputs,
    recorder: Recorder,
    folder: Path,
) -> None:
    """Write dense.ply and the `outputs`. Raises DenseError where raster_cell is too small for the extent."""
    with recorder.meter(3, "writing", "") as advance:
        write_dense(dense.cloud, folder / DENSE_CLOUD)
        advance(1, "")
        if outputs.raster or outputs.mesh or outputs.geotiff:
            raster = _raster_of(dense.cloud, outputs)
            advance(1, "")
            _write_surface(raster, outputs, folder)
    if outputs.depth_maps:
        _write_depth_maps(dense, scene, options, recorder, folder / DEPTH_MAPS)


def remove_dense_outputs(folder: Path) -> None:
    """Remove what a dense stage has finished in a run folder; the parts of an unfinished one stay."""
    for name in DENSE_RESULTS:
        (folder / name).unlink(missing_ok=True)
    maps = [path for end in ("npz", "png") for path in (folder / DEPTH_MAPS).rglob(f"*_depth.{end}")]
    for path in maps:
        path.unlink()
    for place in sorted({place for path in maps for place in path.parents}, key=lambda p: -len(p.parts)):
        if folder in place.parents:
            remove_if_empty(place)


def remove_if_empty(folder: Path) -> None:
    """Remove a folder in which nothing lies."""
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def depth_map_stems(names: Sequence[str]) -> dict[str, str]:
    """For each image the path of its depth map, without "_depth" and ending: its name without its own ending, which it
    keeps where another image has the same name but for that."""
    stems = {name: str(Path(name).with_suffix("")) for name in names}
    times = Counter(stems.values())
    return {name: stem if times[stem] == 1 else name for name, stem in stems.items()}


def _raster_of(cloud: DenseCloud, outputs: DenseOutputs) -> Raster:
    try:
        return rasterize(cloud, outputs.raster_cell)
    except ValueError as error:
        raise DenseError(f"outputs.raster_cell: {error}") from None


def _write_surface(raster: Raster, outputs: DenseOutputs, folder: Path) -> None:
    if outputs.raster:
        write_raster(raster, folder)
        draw_raster(raster, folder / "dsm.png")
    if outputs.geotiff:
        write_geotiff(raster, folder / "dsm.tif", outputs.crs)
    if outputs.mesh:
        write_mesh(height_field_mesh(raster), folder / "mesh.ply")


def _write_depth_maps(dense: Dense, scene: Scene, options: DenseOptions, recorder: Recorder, folder: Path) -> None:
    stems, count = depth_map_stems(scene.views.names), scene.views.num_registered
    for found in recorder.track(depth_maps(dense, scene, options), count, "depth maps", "image"):
        write_depth_map(found, folder / f"{stems[found.name]}_depth.npz")
        draw_depth_map(found, folder / f"{stems[found.name]}_depth.png")
