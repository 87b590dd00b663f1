"""An alignment from files, adjusted anew with refraction, into files."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.commands.run_folder import RunFolder
from torchrefrac.config import FRESH_WATER, AdjustOptions, OptionError
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.files.cameras import write_cameras, write_points
from torchrefrac.files.colmap.model import STEMS, find_colmap, write_colmap
from torchrefrac.files.survey import read_survey
from torchrefrac.files.tracks import read_alignment, write_tracks
from torchrefrac.files.truth import load_truth
from torchrefrac.files.water import Water, read_water, write_water
from torchrefrac.geometry import Plane, Similarity
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Alignment, Reconstruction, Survey, Truth
from torchrefrac.sfm.readjust import ReadjustOptions, readjust
from torchrefrac.sfm.readjusted import Readjusted
from torchrefrac.sfm.water_level import find_offset

MODEL, WATER, TRACKS = "colmap", "water.json", "tracks.npz"
LEVEL = [0.0, 0.0, 1.0]


def readjust_run(options: AdjustOptions, recorder: Recorder, folder: Path) -> dict[str, Any]:
    """Read the alignment, the water and the survey, adjust, evaluate where truth is at hand, and leave everything in
    `folder`. Returns the metrics.

    `folder` then holds colmap/, water.json, points.ply (with a standard deviation for every point), tracks.npz and
    metrics.json; and cameras.json where there is one lens and the water is the plane z = 0. metrics.json says why,
    where this fails. Raises OptionError, before anything is written, where the results would replace what was given.
    """
    require_apart(Path(options.alignment), folder)
    files = RunFolder(folder)
    with files.recording(command="adjust", source=str(Path(options.alignment).resolve())), _stage(files, "adjusting"):
        _remove_results(folder)
        alignment = read_alignment(options.alignment)
        truth = _truth(options)
        survey = read_survey(options.survey, alignment.names) if options.survey else Survey.empty(alignment.names)
        water = _water(options, alignment)
        readjust_options: ReadjustOptions = options
        if options.plane.offset == "find":
            readjust_options = _with_varying_height(options)
            offset = find_offset(alignment, water, survey, readjust_options, recorder)
            water = replace(water, offset=torch.tensor([offset], dtype=torch.float64))
        result = readjust(alignment, water, survey, readjust_options, recorder)
        with recorder.meter(2, "evaluating", "") as advance:
            files.metrics |= _summary(alignment, survey, result)
            if truth is not None and len(result.water.offset) == 1:
                files.metrics |= evaluate(_above_level_water(result), truth)[0]
            advance(1, "")
            _write(result, folder, options.format == "binary")
            advance(1, "")
    return files.metrics


def require_apart(alignment: Path, folder: Path) -> None:
    """Raise OptionError where results in `folder` would replace the alignment, or a model that no run has written."""
    place, into = alignment.resolve(), folder.resolve()
    found = find_colmap(alignment)
    if into in (place, found and found[0].resolve()) or place == into / MODEL:
        raise OptionError(
            f"out is {folder}, where the alignment lies, but the one that was given must stay; name another folder"
        )
    if find_colmap(into / MODEL) is not None and not (into / "metrics.json").is_file():
        raise OptionError(f"{folder} holds a COLMAP model that no run has written; name another folder as out")


@contextmanager
def _stage(files: RunFolder, name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    files.stage_done(name, None, time.perf_counter() - start)


def _remove_results(folder: Path) -> None:
    """Those of an earlier adjustment that a `RunFolder` does not know."""
    model = folder / MODEL
    for path in (folder / WATER, *(model / f"{s}{end}" for s in STEMS for end in (".txt", ".bin"))):
        path.unlink(missing_ok=True)


def _truth(options: AdjustOptions) -> Truth | None:
    if options.truth is None:
        return load_truth(Path(options.alignment))
    truth = load_truth(Path(options.truth))
    if truth is None:
        raise OptionError(f"truth is {options.truth}, but must be a folder that holds a truth.json")
    return truth


def _water(options: AdjustOptions, alignment: Alignment) -> Water:
    if options.water.path is not None:
        water = read_water(options.water.path)
        return water if options.index_ratio is None else replace(water, index_ratio=options.index_ratio)
    ratio = FRESH_WATER if options.index_ratio is None else options.index_ratio
    normal = torch.tensor(options.plane.normal, dtype=torch.float64)
    given = 0.0 if options.plane.offset == "find" else options.plane.offset
    offset = torch.tensor([given], dtype=torch.float64)
    return Water(ratio, (normal / normal.norm())[None], offset / normal.norm(), length_unit=alignment.length_unit)


def _with_varying_height(options: AdjustOptions) -> AdjustOptions:
    refine = dict.fromkeys((*options.bundle.refine, "plane_height"))
    return replace(options, bundle=replace(options.bundle, refine=tuple(refine)))


def _summary(given: Alignment, survey: Survey, result: Readjusted) -> dict[str, Any]:
    adjusted, known, unit = result.alignment, result.assessment, given.length_unit
    metrics: dict[str, Any] = {
        "length_unit": unit,
        "images": len(given),
        "adjusted_images": len(adjusted),
        "points": len(adjusted.points),
        "observations": len(adjusted.image),
        "dropped_points": len(given.points) - len(adjusted.points),
        "dropped_observations": len(given.image) - len(adjusted.image),
        "points_not_triangulated": result.unplaced,
        "reprojection_median_px": float(result.errors.median()),
        "reprojection_median_before_px": float(result.errors_before.median()),
        "index_ratio": result.water.index_ratio,
        "index_ratio_sigma": known.index_ratio_sigma,
        f"camera_shift_median_{unit}": float(result.shift.median()),
        f"camera_shift_max_{unit}": float(result.shift.max()),
        "pixel_sigma_px": known.pixel_sigma,
        "determined": list(known.determined),
        "held": dict(known.held),
        "adjustment": result.status,
    }
    if known.point_sigma is not None:
        metrics[f"point_sigma_median_{unit}"] = float(known.point_sigma.median())
    told = {
        "marks": result.marks,
        "lost_marks": [*result.lost_marks, *survey.skipped_marks],
        "lost_images": list(result.lost_images),
        "images_only_in_survey": list(survey.skipped),
    }
    return metrics | {name: value for name, value in told.items() if value}


def _write(result: Readjusted, folder: Path, binary: bool) -> None:
    alignment, water = result.alignment, result.water
    write_colmap(alignment, folder / MODEL, binary, result.point_errors())
    write_water(water, folder / WATER)
    write_points(alignment.points, alignment.colors, folder / "points.ply", result.assessment.point_sigma)
    write_tracks(alignment, folder / TRACKS)
    if len(alignment.lenses) == 1 and water.normal.tolist() == [LEVEL] and water.offset.tolist() == [0.0]:
        write_cameras(_reconstruction(result), folder / "cameras.json")


def _reconstruction(result: Readjusted) -> Reconstruction:
    alignment = result.alignment
    return Reconstruction(
        names=alignment.names,
        registered=torch.ones(len(alignment), dtype=torch.bool),
        rotation=alignment.rotation,
        center=alignment.center,
        intrinsics=alignment.lenses[0],
        index_ratio=result.water.index_ratio,
        length_unit=alignment.length_unit,
        points=alignment.points,
        colors=alignment.colors,
        image=alignment.image,
        point=alignment.point,
        pixels=alignment.pixels,
    )


def _above_level_water(result: Readjusted) -> Reconstruction:
    """In a frame in which its one water surface is z = 0, as it is in that of the truth; reprojection is then that of
    the first lens."""
    normal, offset = result.water.normal[0], result.water.offset[0]
    across, along = Plane(normal, offset, check=False).tangents_like(normal)
    level = Similarity(
        torch.ones_like(offset), torch.stack((across, along, normal)), -offset * normal.new_tensor(LEVEL)
    )
    plain = _reconstruction(result)
    return replace(
        plain,
        rotation=level.apply_to_rotation(plain.rotation),
        center=level.apply(plain.center),
        points=level.apply(plain.points),
    )
