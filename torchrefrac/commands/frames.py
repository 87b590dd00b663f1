"""One dense surface for each moment that fixed cameras have photographed, by the poses of a run."""

import csv
import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.atomic import replacing
from torchrefrac.commands.densify import dense_stage, open_run
from torchrefrac.commands.pairs import choose_pairs
from torchrefrac.commands.photographs import extract, match_pairs
from torchrefrac.commands.results import OutRefusedError, results_in
from torchrefrac.commands.run_folder import RunFolder
from torchrefrac.config import DensifyOptions, OptionError, Options
from torchrefrac.evaluate.metrics import evaluate_run
from torchrefrac.files.paths import real_path
from torchrefrac.files.swap import remove_if_empty
from torchrefrac.files.track_table import view_numbers
from torchrefrac.parallel import Workers
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Capture, CaptureError, Scene
from torchrefrac.sfm import Rules
from torchrefrac.sfm.known_cameras import points_of_photographs

SUMMARY = "frames.csv"
COLUMNS = ("frame", "status", "images", "points", "dense_points", "seconds", "reason")
FEWEST_VIEWS = 2
SECONDS_A_FRAME = 30.0


@dataclass(frozen=True)
class Frame:
    """One moment: its folder of photographs, and where the results go."""

    photographs: Path
    out: Path
    options: DensifyOptions


def densify_frames(options: DensifyOptions, recorder: Recorder) -> list[dict[str, Any]]:
    """Make every folder of photographs that `options.frames` matches dense, with the cameras of the run, each into a
    folder of its own in `options.out`, as many at a time as `options.executor` says; returns a row of
    frames.csv for each, which is written after every one.

    Photographs have the names that the run knows (their endings may differ), in the folder or in images/ there. A frame
    that fails has the reason in its row, and does not stop the others. Raises OptionError where nothing matches, and
    whatever is wrong with the run.
    """
    out = Path(options.out or "")
    open_run(Path(options.run), options.capture)
    folders = sorted(Path(name) for name in glob.glob(os.path.expanduser(options.frames or "")) if Path(name).is_dir())
    if not folders:
        raise OptionError(f"frames is {options.frames!r}, which matches no folder; give folders of photographs")
    names = [folder.name for folder in folders]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise OptionError(f"frames matches several folders of the name {twice}; results would lie in one")
    if out.exists() and not out.is_dir():
        raise OutRefusedError(f"{out} is a file, but out must be a folder for the results")
    out.mkdir(parents=True, exist_ok=True)
    jobs = [Frame(folder, out / folder.name, options) for folder in folders]
    rows: dict[str, dict[str, Any]] = {}
    with Workers(options.executor) as workers:
        for _, row in recorder.track(workers.each(densify_frame, jobs, SECONDS_A_FRAME), len(jobs), "frames", "frame"):
            rows[row["frame"]] = row
            _write([rows[name] for name in names if name in rows], out / SUMMARY)
    return [rows[name] for name in names]


def frame_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What is printed."""
    done = [row for row in rows if row["status"] == "complete"]
    lines = [f"{len(done)} of {len(rows)} frames are dense"]
    if done:
        counts = sorted(row["dense_points"] for row in done)
        lines[0] += f", with {counts[0]} to {counts[-1]} points"
    return [*lines, *(f"{row['frame']}: {row['reason']}" for row in rows if row["status"] != "complete")]


def densify_frame(job: Frame) -> dict[str, Any]:
    """Its row of frames.csv; what is wrong with the frame is the reason there."""
    row: dict[str, Any] = {"frame": job.photographs.name, "status": "failed"}
    try:
        with results_in(job.out) as place:
            metrics = _densified(job, place)
    except (CaptureError, OptionError, OSError, RuntimeError, ValueError) as error:
        remove_if_empty(job.out, job.out.parent)
        return row | {"reason": " ".join(str(error).split()) or type(error).__name__}
    known = {name: metrics.get(name) for name in ("images", "points", "dense_points")}
    return row | {"status": "complete", **known, "seconds": metrics.get("seconds_total")}


def _densified(job: Frame, place: Path) -> dict[str, Any]:
    options, usual = job.options, Options()
    run = open_run(Path(options.run), options.capture)
    scene = of_frame(run.scene, job.photographs)
    assert scene.capture is not None
    files, silent = RunFolder(place), SilentRecorder()
    about = {"model": "refractive", "capture": str(real_path(scene.capture.folder)), "cameras_of": str(run.folder)}
    with files.recording(**about):
        features = extract(scene.capture, usual, silent)
        chosen = choose_pairs(scene.capture, features, usual.matching, usual.seed)
        matches = match_pairs(features, chosen, usual.matching, silent)
        rules = Rules(max_error=usual.sfm.max_error, min_angle_deg=usual.sfm.min_angle_deg, bundle=usual.sfm.bundle)
        found = points_of_photographs(scene, features, matches, rules)
        files.stage_done("sparse", found, 0.0)
        metrics, alignment = evaluate_run(found, None)
        files.complete(found, metrics, None, alignment)
        dense_stage(files, found, options.dense, options.outputs, None, None, silent)
    return files.metrics


def of_frame(scene: Scene, folder: Path) -> Scene:
    """The registered views of a run that a folder has photographs of, with these."""
    assert scene.capture is not None
    views, numbers, files = scene.views, view_numbers(scene.views.names), {}
    for place in (folder / "images", folder):
        for path in sorted(place.rglob("*")):
            name = path.relative_to(place)
            number = numbers.get(name.as_posix(), numbers.get(name.with_suffix("").as_posix()))
            if number is not None and path.is_file():
                files[number] = path
    here = torch.tensor([number in files for number in range(len(views))]) & views.registered
    if int(here.sum()) < FEWEST_VIEWS:
        known = ", ".join(views.names[:3])
        raise CaptureError(
            f"{folder} has photographs of {int(here.sum())} of the cameras of the run, but two are needed; they must "
            f"be named as there: {known}, ..."
        )
    scene = scene.of_views(here)
    capture: Capture | None = scene.capture
    assert capture is not None
    paths = tuple(files[number] for number in here.nonzero()[:, 0].tolist())
    return replace(scene, capture=replace(capture, folder=folder, paths=paths))


def _write(rows: Sequence[dict[str, Any]], path: Path) -> None:
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        table: csv.DictWriter[str] = csv.DictWriter(file, COLUMNS, restval="")
        table.writeheader()
        table.writerows(rows)
