"""A reconstruction from files, adjusted with refraction, into files."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.commands.results import MODEL, OutRefusedError, require_not_replaced, run_record
from torchrefrac.commands.run_folder import RunFolder, write_model, write_scene
from torchrefrac.config import FRESH_WATER, LEVEL, AdjustOptions, OptionError, PlaneOptions
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.evaluate.survey_consistency import survey_contradictions
from torchrefrac.evaluate.survey_metrics import survey_metrics
from torchrefrac.evaluate.water_levels import slope_metrics
from torchrefrac.files.cameras import CAMERAS
from torchrefrac.files.capture import load_capture
from torchrefrac.files.colmap.model import find_colmap, read_ids
from torchrefrac.files.colmap.tables import Ids
from torchrefrac.files.paths import real_path
from torchrefrac.files.run import RunRecord
from torchrefrac.files.survey import read_survey
from torchrefrac.files.tracks import read_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.files.water import WATER, read_water
from torchrefrac.geometry import Similarity
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Interfaces, Scene, Survey, Truth
from torchrefrac.sfm import (
    Outcome,
    Placed,
    ReadjustOptions,
    placed_in_survey,
    readjust,
    upright,
    with_found_level,
    with_found_normal,
)
from torchrefrac.sfm.frame import transformed
from torchrefrac.sfm.positions import surveyed
from torchrefrac.sfm.stated_levels import StatedLevels


def adjust(
    scene: Scene,
    *,
    survey: Survey | None = None,
    options: ReadjustOptions | None = None,
    recorder: Recorder | None = None,
) -> Scene:
    """The scene adjusted with refraction at its interfaces and the measurements of a survey, in whose frame it is
    brought before if it stands elsewhere; only what fits stays.

    Raises what `sfm.placed_in_survey` and `sfm.readjust` raise.
    """
    survey = survey or Survey.empty(scene.views.names)
    placed = placed_in_survey(scene, survey, recorder).scene
    return _finished(*readjust(placed, survey, options, recorder), survey)


def adjust_run(options: AdjustOptions, recorder: Recorder, folder: Path) -> dict[str, Any]:
    """Read the reconstruction, the water and the survey, adjust, evaluate where truth is at hand, and leave everything
    in `folder`. Returns the metrics.

    `folder` then holds colmap/, water.json, points.ply (with a standard deviation for every point), tracks.npz,
    cameras.json and metrics.json, which says why, where this fails. Of a run its own water, photographs and truth are
    taken where the options name none. Raises OutRefusedError, before anything is written, where the results would
    replace what was given.
    """
    require_apart(options, folder)
    files, given = RunFolder(folder, with_model=True), run_record(Path(options.alignment))
    about = {"command": "adjust", "source": str(real_path(options.alignment))}
    if given is not None and given.capture is not None:
        about["capture"] = str(given.capture)
    with files.recording(**about), _stage(files, "adjusting"):
        scene = read_scene(options.alignment)
        truth = _truth(options, given)
        names = scene.views.names
        survey = read_survey(options.survey, names, scene.georeference) if options.survey else Survey.empty(names)
        read = _with_water(scene, options, given)
        placed = placed_in_survey(read, survey, recorder, not _states_water(options, given))
        if survey.level_sources and not _states_water(options, given):
            placed = replace(placed, scene=_at_stated_level(placed.scene, survey))
        how = _with_varying_plane(options)
        placed = _with_found_plane(placed, survey, how, recorder)
        scene = placed.scene
        everything, outcome = readjust(scene, survey, how, recorder)
        with recorder.meter(2, "evaluating", "") as advance:
            adjusted = _finished(everything, outcome, survey)
            files.metrics |= _summary(scene, adjusted, outcome) | _lost(everything) | _placing(placed, read)
            files.metrics |= slope_metrics(adjusted, survey)
            files.metrics |= survey_metrics(surveyed(everything, survey, outcome.survey or survey), scene.length_unit)
            if truth is not None and len(adjusted.interfaces) == 1:
                files.metrics |= evaluate(_above_level_water(adjusted), truth)[0]
            advance(1, "")
            ids = read_ids(options.alignment) if read.cameras.read_as else None
            _write(adjusted, folder, options.format == "binary", ids)
            advance(1, "")
    return files.metrics


def require_apart(options: AdjustOptions, folder: Path) -> None:
    """Raise OutRefusedError where results in `folder` would replace what is given, or a model that no run wrote."""
    given = Path(options.alignment)
    place, into = real_path(given), real_path(folder)
    found = find_colmap(given)
    if into in (place, found and real_path(found[0])) or place == into / MODEL:
        raise OutRefusedError(
            f"out is {folder}, where the alignment lies, but the one that was given must stay; name another folder"
        )
    if find_colmap(into / MODEL) is not None and not (into / "metrics.json").is_file():
        raise OutRefusedError(f"{folder} holds a COLMAP model that no run has written; name another folder as out")
    require_not_replaced(folder, "water.path", options.water.path)
    require_not_replaced(folder, "survey", options.survey)


@contextmanager
def _stage(files: RunFolder, name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    files.stage_done(name, None, time.perf_counter() - start)


def _truth(options: AdjustOptions, run: RunRecord | None) -> Truth | None:
    """The one that is named, or that of the alignment, or of the photographs that it was made from."""
    if options.truth is None:
        own = load_truth(Path(options.alignment))
        return own if own is not None or run is None or run.capture is None else load_truth(run.capture)
    truth = load_truth(Path(options.truth))
    if truth is None:
        raise OptionError(f"truth is {options.truth}, but must be a folder that holds a truth.json")
    return truth


def _states_water(options: AdjustOptions, run: RunRecord | None) -> bool:
    """Whether the water is stated in the frame of the alignment: by options, or because it is that of a run. Else it is
    z = 0, or lies level, where the survey has the alignment."""
    is_run = run is not None or (Path(options.alignment) / CAMERAS).is_file()
    is_said = is_run or options.water.path is not None or not options.plane.is_level
    return is_said and options.plane.normal != "find"


def _with_water(scene: Scene, options: AdjustOptions, run: RunRecord | None) -> Scene:
    """The scene behind the interfaces of a water.json, or behind the one plane of the options. An adjusted run has a
    water.json of its own, and other runs have walls, ports and several levels, which count where the options say
    nothing else."""
    path = options.water.path
    own = None if run is None or run.command != "adjust" else run.folder / WATER
    if path is None and own is not None and own.is_file() and options.plane == PlaneOptions():
        path = str(own)
    interfaces, rows = scene.interfaces, scene.views.interface
    if path is not None:
        interfaces, rows = read_water(path, scene.views.names)
    if path is not None or (options.plane == PlaneOptions() and interfaces.refract() and not interfaces.are_plain):
        if options.index_ratio is not None:
            interfaces = replace(interfaces, index_ratio=torch.full_like(interfaces.index_ratio, options.index_ratio))
        return replace(scene, interfaces=interfaces, views=replace(scene.views, interface=rows))
    normal = torch.tensor(LEVEL if options.plane.normal == "find" else options.plane.normal, dtype=torch.float64)
    given = 0.0 if options.plane.offset == "find" else options.plane.offset
    offset = torch.tensor([given], dtype=torch.float64)
    ratio = _index_ratio(scene, options, run)
    interfaces = Interfaces((normal / normal.norm())[None], offset / normal.norm(), torch.full_like(offset, ratio))
    return replace(scene, interfaces=interfaces)


def _index_ratio(scene: Scene, options: AdjustOptions, run: RunRecord | None) -> float:
    """The one that is given, or that of the run, or of its photographs where the run was without refraction."""
    if options.index_ratio is not None:
        return options.index_ratio
    is_run = (Path(options.alignment) / CAMERAS).is_file()
    if is_run and (scene.index_ratio > 1.0 or (run is not None and run.model == "refractive")):
        return scene.index_ratio
    capture = None if run is None else run.capture
    return FRESH_WATER if capture is None or not capture.is_dir() else load_capture(capture).index_ratio


def _at_stated_level(scene: Scene, survey: Survey) -> Scene:
    """With its one plane where the survey states the water."""
    levels = StatedLevels.of(survey, scene)
    weight = levels.sigma.square().reciprocal()
    offset = ((weight * levels.height).sum() / weight.sum()).reshape(1)
    return replace(scene, interfaces=replace(scene.interfaces, offset=offset))


def _with_varying_plane(options: AdjustOptions) -> AdjustOptions:
    """What is searched for of the plane varies afterwards."""
    refine = dict.fromkeys((*options.bundle.refine, *options.plane.refined))
    return replace(options, bundle=replace(options.bundle, refine=tuple(refine)))


def _with_found_plane(placed: Placed, survey: Survey, options: AdjustOptions, recorder: Recorder) -> Placed:
    """With what is to be found of the plane: level where the survey says what is, else as the images show it."""
    plane = options.plane
    if plane.normal == "find":
        found = upright(placed, survey)
        if found is None and plane.offset != "find":
            raise OptionError(
                f"plane.normal is find, but plane.offset is {plane.offset}: without gravity or positions in a survey "
                "the height of the water along a normal that nobody knows must be found, too; set plane.offset=find"
            )
        if found is None:
            return replace(placed, scene=with_found_normal(placed.scene, survey, options, recorder)[0])
        placed = found
    if plane.offset == "find":
        return replace(placed, scene=with_found_level(placed.scene, survey, options, recorder))
    return placed


def _finished(scene: Scene, outcome: Outcome, survey: Survey) -> Scene:
    """Registered views and the points that stayed, without the ground control points, which are the last ones; and what
    the images say against the survey."""
    tied = scene.accepted & (scene.observations.point < len(scene.points) - len(survey.control_names))
    findings = survey_contradictions(scene, survey, outcome.survey or survey)
    return replace(scene, accepted=tied, findings=findings).of_views(scene.views.registered).trimmed()


def _summary(given: Scene, adjusted: Scene, outcome: Outcome) -> dict[str, Any]:
    known, unit = adjusted.assessment, given.length_unit
    row = {name: i for i, name in enumerate(given.views.names)}
    shift = (adjusted.views.center - given.views.center[[row[name] for name in adjusted.views.names]]).norm(dim=-1)
    assert outcome.report is not None
    metrics: dict[str, Any] = {
        "length_unit": unit,
        "images": len(given.views),
        "adjusted_images": len(adjusted.views),
        "points": len(adjusted.points),
        "observations": len(adjusted.observations),
        "dropped_points": len(given.points) - len(adjusted.points),
        "dropped_observations": len(given.observations) - len(adjusted.observations),
        "points_not_triangulated": outcome.numbers["not_triangulated"],
        "reprojection_median_px": float(adjusted.errors().median()),
        "reprojection_median_before_px": outcome.numbers["median_before"],
        "index_ratio": adjusted.index_ratio,
        "index_ratio_sigma": known.index_ratio_sigma,
        f"camera_shift_median_{unit}": float(shift.median()),
        f"camera_shift_max_{unit}": float(shift.max()),
        "pixel_sigma_px": known.pixel_sigma,
        "determined": list(known.determined),
        "held": dict(known.fixed),
        "adjustment": outcome.report.status,
        "warnings": [finding.content for finding in adjusted.findings],
    }
    outside = int(adjusted.outside_water().sum())
    if outside:
        metrics["points_outside_water"] = outside
    if known.point_sigma is not None:
        metrics[f"point_sigma_median_{unit}"] = float(known.point_sigma.median())
    return metrics


def _placing(placed: Placed, given: Scene) -> dict[str, Any]:
    """How the given alignment was brought into the frame of the survey, if it was."""
    if placed.change is None:
        return {}
    return {
        "survey_scale": float(placed.change.scale),
        "survey_turn_deg": placed.turn_deg,
        f"survey_shift_{given.length_unit}": placed.shift(given),
    }


def _lost(scene: Scene) -> dict[str, Any]:
    """Which images did not fit the rest."""
    views = zip(scene.views.names, scene.views.registered.tolist(), strict=True)
    lost = [name for name, registered in views if not registered]
    return {"lost_images": lost} if lost else {}


def _write(scene: Scene, folder: Path, binary: bool, ids: Ids | None) -> None:
    write_model(scene, folder, binary, ids)
    write_scene(scene, folder)


def _above_level_water(scene: Scene) -> Scene:
    """In a frame in which its one surface is z = 0, as it is in that of the truth; behind ports any is as good."""
    if scene.interfaces.move_with_camera:
        return scene
    normal, offset = scene.interfaces.normal[0], scene.interfaces.offset[0]
    across, along = (tangent[0] for tangent in scene.interfaces.planes.tangents_like(normal))
    up = normal.new_tensor((0.0, 0.0, 1.0))
    level = Similarity(torch.ones_like(offset), torch.stack((across, along, normal)), -offset * up)
    at_zero = replace(scene.interfaces, normal=up[None], offset=torch.zeros_like(scene.interfaces.offset))
    return replace(transformed(scene, level), interfaces=at_zero)
