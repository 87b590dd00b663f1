"""Points of tracks that another program made, through the cameras of a run, into a file."""

import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.commands.export import read_posed
from torchrefrac.commands.results import OutRefusedError, require_replaceable
from torchrefrac.config.clouds import TriangulateOptions
from torchrefrac.files.capture import PIXEL_SHIFT
from torchrefrac.files.paths import real_path
from torchrefrac.files.run import RunRecord
from torchrefrac.files.swap import alone
from torchrefrac.files.track_table import read_track_table, write_track_points
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.refinement import PointEstimate
from torchrefrac.scene import CaptureError, Observations, Scene, largest_deviation
from torchrefrac.sfm import triangulate_tracks

POINTS = "points.csv"
PART = 100_000  # points at once


def triangulate_run(options: TriangulateOptions, recorder: Recorder | None = None) -> dict[str, Any]:
    """Write points.csv, the points of the tracks that two views or more agree on, and metrics.json into the folder
    `out`; returns the metrics. Lengths and axes are those of the run.

    Raises SceneError, CaptureError or OutRefusedError, each one sentence, and leaves everything as it is then.
    """
    start, path = time.perf_counter(), Path(options.tracks)
    folder = path.with_name(f"{path.stem}_3d") if options.out is None else Path(options.out)
    if real_path(folder / POINTS) == real_path(path):
        raise OutRefusedError(f"out is {folder}, where the tracks lie, but they must stay; name another folder")
    require_replaceable(folder, "triangulate", (POINTS,))
    scene = read_posed(Path(options.run))
    table = read_track_table(path, scene.views.names, PIXEL_SHIFT[options.pixel_origin])
    found = _in_parts(scene, table.observations, options, recorder or SilentRecorder())
    length = torch.bincount(table.observations.point)
    if not bool(found.valid.any()):
        raise CaptureError(
            f"{path}: none of {len(length)} points can be placed: {int((length < 2).sum())} are seen by one view only, "
            f"of the others no two observations agree within max_error={options.max_error:g} px; check pixel_origin "
            "and that the run's cameras have not moved"
        )
    set_aside = torch.where(found.valid, length - found.num_views, 0)
    metrics = {
        "status": "complete",
        "stages": [],
        "command": "triangulate",
        "run": str(real_path(options.run)),
        "tracks": str(real_path(path)),
        "file": str(real_path(folder / POINTS)),
        "length_unit": scene.length_unit,
        "images": len(scene.views),
        "observations": len(table.observations),
        "observations_set_aside": int(set_aside.sum()),
        **point_metrics(found, length, scene.length_unit),
    }
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        write_track_points(folder / POINTS, table.names, found, set_aside, found.valid)
        metrics["seconds_total"] = round(time.perf_counter() - start, 3)
        RunRecord.of(folder, metrics).write()
    return metrics


def point_metrics(found: PointEstimate, length: Int[Tensor, " n"], unit: str) -> dict[str, Any]:
    """How many points there are of tracks of this `length`, and how good they are."""
    placed, views = found.valid, found.num_views[found.valid]
    square = (found.rms[placed].square() * views).sum() / views.sum()
    return {
        "points": int(placed.sum()),
        "points_of_one_view": int((length < 2).sum()),
        "points_contradicted": int((~placed & (length >= 2)).sum()),
        "reprojection_rms_px": float(square.sqrt()),
        f"point_sigma_median_{unit}": float(largest_deviation(found.covariance[placed]).median()),
    }


def _in_parts(scene: Scene, seen: Observations, options: TriangulateOptions, recorder: Recorder) -> PointEstimate:
    """The points of all observations, PART of them at once, so that memory does for any number."""
    order = seen.point.argsort(stable=True)
    sorted_point, found = seen.point[order], []
    count = int(sorted_point[-1]) + 1
    edges = torch.searchsorted(sorted_point, torch.arange(0, count + PART, PART)).tolist()
    with recorder.meter(count, "triangulating", "point") as advance:
        for i, first in enumerate(range(0, count, PART)):
            part = seen[order[edges[i] : edges[i + 1]]]
            part = replace(part, point=part.point - first)
            found.append(triangulate_tracks(scene, part, options.pixel_sigma, options.max_error)[0])
            advance(len(found[-1].points), "")
    names = [field.name for field in fields(PointEstimate)]
    return PointEstimate(**{name: torch.cat([getattr(part, name) for part in found]) for name in names})
