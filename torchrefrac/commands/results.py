"""Where a command leaves its results: beside those of before until they are complete, and never in place of anything
that no run has written."""

import os
import shutil
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count, takewhile
from pathlib import Path
from typing import Any

from torchrefrac.commands.dense_outputs import depth_map_files
from torchrefrac.config import OptionError
from torchrefrac.files.colmap.model import STEMS
from torchrefrac.files.paths import real_path
from torchrefrac.files.run import (
    DENSE_RESULTS,
    DEPTH_MAPS,
    METRICS,
    PAGES,
    PARTS,
    REPORT,
    SCENE_PAGE,
    WORK,
    RunRecord,
    RunRecordError,
    RunStatus,
)
from torchrefrac.files.swap import PARTIAL, alone, finish, swap
from torchrefrac.files.water import WATER
from torchrefrac.record.recorders import EVENTS, LOG

MODEL, OPTIONS = "colmap", ".hydra"
RESULTS = ("features.npz", "matches.npz", "cameras.json", "points.ply", "tracks.npz", "side_view.png", SCENE_PAGE)
FURTHER, SCENE_FILES = "reconstructions", ("cameras.json", "points.ply", "tracks.npz")
"""Of a run that falls into several: the metric that has them, and what is written of each beside the largest."""
MODEL_FILES = (WATER, *(f"{MODEL}/{stem}{end}" for stem in STEMS for end in (".txt", ".bin")))
ABOUT = (METRICS, REPORT, LOG, EVENTS, OPTIONS, WORK)  # what a folder without results may hold where nobody works
OWN_FOLDERS = (DEPTH_MAPS, MODEL, EVENTS, OPTIONS, WORK, PARTIAL)


class OutRefusedError(OptionError):
    """Results may not go to a folder; the message names it and says why."""


@contextmanager
def results_in(folder: Path, *, with_model: bool = False, goes_on: bool = False) -> Generator[Path, None, None]:
    """The folder to work in so that the results lie in `folder` at the end.

    It is `folder` itself where no results lie there; else a folder inside, whose files take the place of those of
    earlier runs, as a whole, when the block has ended. Where the block fails, what there was stays, unless it was not
    complete either and no more stages were. with_model: a COLMAP model is written, too. goes_on: all but the dense
    results is copied first, as only these are made anew.

    Raises FolderInUseError where another process works there, OutRefusedError where results would take the place of
    files that no run has written; nothing is changed then.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        finish(folder)
        require_own(folder, with_model, dense_alone=goes_on)
        before = run_record(folder)
        if before is None or not any(_results(folder, has_model(before))):
            yield folder
            return
        earlier, place = [*_results(folder, has_model(before)), *_about(folder)], folder / PARTIAL
        _begin(place, earlier, before, goes_on)
        try:
            yield place
        except BaseException:
            after = run_record(place)
            if after is not None and _gives_way(before, after, goes_on):
                swap(place, earlier)
            raise
        else:
            swap(place, earlier)
        finally:
            shutil.rmtree(place, ignore_errors=True)


def run_record(folder: Path) -> RunRecord | None:
    """The record that a run has left in a folder; None where there is none, or it is of something else."""
    try:
        record = RunRecord.read(folder)
    except RunRecordError:
        return None
    return None if record.status is RunStatus.UNKNOWN else record


def holds_nothing(folder: Path) -> bool:
    """Whether nothing lies in a folder but what runs without results leave there."""
    if not folder.is_dir():
        return not folder.exists()
    own = not (folder / METRICS).exists() or run_record(folder) is not None
    return own and {path.name for path in folder.iterdir()} <= set(ABOUT)


def require_own(folder: Path, with_model: bool = False, dense_alone: bool = False) -> None:
    """Raise OutRefusedError where results in `folder` would replace files that no run has written."""
    record = run_record(folder)
    if record is None and (folder / METRICS).exists():
        raise OutRefusedError(f"{folder / METRICS} is not of a run, but would be replaced; name another folder as out")
    foreign: Iterable[str] = ()
    if record is None:
        foreign = _dense_results(folder) if dense_alone else _results(folder, with_model)
    elif with_model and not has_model(record):
        foreign = _present(folder, MODEL_FILES)
    for name in foreign:
        raise OutRefusedError(f"{folder} holds {name}, which no run has written; name another folder as out")


def require_replaceable(folder: Path, command: str, names: Iterable[str]) -> None:
    """Raise OutRefusedError where files of these names, which a command writes whole and at once, would replace any
    that it has not written itself."""
    record = run_record(folder)
    if record is not None and record.command == command:
        return
    for name in _present(folder, (METRICS, *names)):
        raise OutRefusedError(f"{folder} holds {name}, which no {command} has written; name another folder as out")


def write_export_record(
    folder: Path, run: str, form: str, files: Sequence[str], known: Mapping[str, Any]
) -> dict[str, Any]:
    """Write into metrics.json what was exported of a run, and what is known of that; returns it."""
    about = {"status": "complete", "stages": [], "command": "export", "run": str(real_path(run))}
    metrics = about | {"format": form, "files": list(files), **known}
    RunRecord.of(folder, metrics).write()
    return metrics


def require_outside(folder: Path, capture: Path) -> None:
    """Raise OutRefusedError where results in `folder` would lie among the photographs of a capture."""
    into, given = real_path(folder), real_path(capture)
    inside = any(into == given / part or given / part in into.parents for part in ("images", "masks"))
    around = any(place == given or place in given.parents for place in (into / own for own in OWN_FOLDERS))
    if into == given or inside or around:
        raise OutRefusedError(f"out is {folder}, where the photographs of {capture} lie; name another folder")


def require_not_replaced(folder: Path, option: str, given: str | None) -> None:
    """Raise OutRefusedError where results in `folder` would replace a file that an option names."""
    if given is None:
        return
    place, into = real_path(given), real_path(folder)
    names = {into / name for name in (*RESULTS, *DENSE_RESULTS, *MODEL_FILES, METRICS, REPORT, LOG)}
    if place in names or any(into / own in place.parents for own in OWN_FOLDERS):
        raise OutRefusedError(
            f"{option} is {given}, which results in {folder} would replace; name another folder as out"
        )


def has_model(record: RunRecord) -> bool:
    """Whether a run has written a COLMAP model beside its other results."""
    return record.command == "adjust" or bool(record.metrics.get(MODEL))


def _present(folder: Path, names: Iterable[str]) -> list[str]:
    return [name for name in names if (folder / name).exists()]


def _dense_results(folder: Path) -> list[str]:
    maps = (path.relative_to(folder).as_posix() for path in depth_map_files(folder))
    return [*_present(folder, DENSE_RESULTS), *maps]


def _results(folder: Path, with_model: bool) -> list[str]:
    """The names of all results that lie in a folder."""
    own = (*RESULTS, *(MODEL_FILES if with_model else ()))
    return [*_present(folder, own), *further_results(folder), *_dense_results(folder)]


def further_folders(folder: Path) -> Iterator[Path]:
    """Of reconstructions beside the largest, which are numbered from 2."""
    return (folder / f"reconstruction_{number}" for number in count(2))


def further_results(folder: Path) -> list[str]:
    """The files of these that lie in the folder of a run."""
    there = takewhile(Path.is_dir, further_folders(folder))
    return [f"{place.name}/{name}" for place in there for name in _present(place, (*SCENE_FILES, *MODEL_FILES))]


def _about(folder: Path) -> list[str]:
    """What runs leave beside results: their record, report, log, events and options."""
    kept = [path for own, pattern in ((EVENTS, "events.out.tfevents.*"), (OPTIONS, "*.yaml"))
            for path in (folder / own).glob(pattern)]  # fmt: skip
    return [*_present(folder, (METRICS, REPORT, LOG)), *(path.relative_to(folder).as_posix() for path in kept)]


def _begin(place: Path, earlier: Iterable[str], before: RunRecord, goes_on: bool) -> None:
    """An empty folder for new results, with what they go on with: log and events where parts of a dense stage wait."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    folder = place.parent
    resumes = (folder / PARTS).is_dir() or (folder / WORK).is_dir()
    dense = {*PAGES, *_dense_results(folder)}
    for name in earlier:
        if (goes_on and name not in dense) or (resumes and name.startswith((LOG, EVENTS))):
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            _copy(folder / name, place / name, as_link=not name.startswith((LOG, OPTIONS)))
    if goes_on:
        RunRecord.of(place, {**before.metrics, "status": "running"}).write()


def _copy(source: Path, target: Path, as_link: bool) -> None:
    """A copy; of files that are never written into, another name of the same where the disk knows such."""
    if as_link:
        try:
            os.link(source, target)
        except OSError:
            shutil.copy2(source, target)
    else:
        shutil.copy2(source, target)


def _gives_way(before: RunRecord, after: RunRecord, goes_on: bool) -> bool:
    """Whether results of before give way to those of a run that broke off, once that has left a word of how."""
    if after.status is RunStatus.RUNNING:
        return False
    return after.is_complete or ((goes_on or not before.is_complete) and set(before.stages) <= set(after.stages))
