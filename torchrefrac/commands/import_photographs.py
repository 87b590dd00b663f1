"""From a memory card to a capture: photographs, what their files say, and what else is known, into capture.json."""

import hashlib
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from torchrefrac.commands.boards import find_marks, pattern_of
from torchrefrac.commands.import_report import found, oddities
from torchrefrac.commands.results import OutRefusedError
from torchrefrac.config.importing import ImportOptions
from torchrefrac.files.fields import Fields, read_json, write_json
from torchrefrac.files.metadata.camera_file import read_camera
from torchrefrac.files.metadata.content import Water, capture_content
from torchrefrac.files.metadata.film import take_frames, write_times
from torchrefrac.files.metadata.gathered import gather, relative_names
from torchrefrac.files.metadata.grouping import by_camera, camera_names
from torchrefrac.files.metadata.half_turns import with_right_halves
from torchrefrac.files.metadata.kinds import left_out_by_kind
from torchrefrac.files.metadata.lens import Lens, centered
from torchrefrac.files.metadata.listing import IMAGES, Listing, common_folder, list_photographs
from torchrefrac.files.metadata.photograph import Photograph, read_photograph
from torchrefrac.files.metadata.placing import place_all
from torchrefrac.files.metadata.position import Vertical
from torchrefrac.files.metadata.quality import look_at, useless
from torchrefrac.files.metadata.subtitles import subtitles_beside
from torchrefrac.files.metadata.table import Row, read_table
from torchrefrac.files.metadata.times import epochs_of
from torchrefrac.files.paths import real_path
from torchrefrac.files.survey import SURVEY, write_survey
from torchrefrac.files.swap import PARTIAL, alone, finish, remove_if_empty, swap
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene.capture import CaptureError

CAPTURE, REPORT, TIMES = "capture.json", "import.json", "frames.csv"
REPORT_FORMAT = "torchrefrac-import/1"
FOCAL_BY_USER_SIGMA = 0.02


class _Selection(NamedTuple):
    """The photographs that are used, and why others are not, by their paths."""

    photographs: list[Photograph]
    left_out: dict[Path, str]


def import_photographs(options: ImportOptions, recorder: Recorder | None = None) -> dict[str, Any]:
    """Write capture.json and import.json into the folder `out`, and survey.json where boards or tags were found;
    returns what import.json says: what was found of which photographs, and where.

    Photographs stay where they are, and nothing is written among them. A capture.json that import wrote, and that
    nobody has changed since, is replaced as a whole. Raises CaptureError where there are fewer than two photographs
    that can be used or something stated cannot be right, OutRefusedError where `out` holds another capture.json, or
    another survey.json and boards were asked for, or lies among the photographs.
    """
    out = real_path(options.out)
    is_new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        with alone(out):
            finish(out)
            earlier, place = _earlier_files(out), out / PARTIAL
            if options.board != "none" and SURVEY not in earlier:
                _require_no_survey(out)
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            try:
                report = _import_into(place, out, options, recorder or SilentRecorder())
                swap(place, earlier)
            finally:
                shutil.rmtree(place, ignore_errors=True)
    finally:
        if is_new:
            remove_if_empty(out, out.parent)
    return report


def _earlier_files(out: Path) -> list[str]:
    """The files of an earlier import into `out`; without a survey.json that was changed since. Raises OutRefusedError
    where there is a capture.json of somebody else."""
    capture, report = out / CAPTURE, out / REPORT
    if not capture.exists():
        return []
    refused = _not_ours(capture)
    if not report.is_file():
        raise refused
    try:
        top = read_json(report)
        if not _is_as_written(capture, top):
            raise refused
        names = [name for name in top.texts("files") if ".." not in Path(name).parts and not Path(name).is_absolute()]
    except CaptureError:
        raise refused from None
    return [name for name in names if name != SURVEY or _is_as_written(out / SURVEY, top)]


def _is_as_written(path: Path, report: Fields) -> bool:
    """Whether a file is the one that an import reported on."""
    return path.is_file() and report.text(f"{path.stem}_sha256", "none") == _digest(path)


def _require_no_survey(out: Path) -> None:
    survey = out / SURVEY
    if survey.exists():
        raise _not_ours(survey)


def _not_ours(path: Path) -> OutRefusedError:
    changed = "was not written by import, or has been changed since"
    return OutRefusedError(f"{path} {changed}; name another folder as out, or remove it")


def _import_into(place: Path, out: Path, options: ImportOptions, recorder: Recorder) -> dict[str, Any]:
    pattern = pattern_of(options)
    listing = list_photographs(options.sources, out)
    film = _film(options, listing)
    frames: dict[Path, float] = {}
    if film is not None:
        frames = _frames(film, place, options, recorder)
        listing = Listing(list(frames), {}, [])
    selection = _select(listing, options, recorder)
    photographs = selection.photographs
    notes: list[str] = []
    subtitles = None if film is None else subtitles_beside(film)
    if subtitles is not None:
        photographs = [subtitles.told(frame, frames[frame.path]) for frame in photographs]
        notes += [subtitles.problem] if subtitles.problem else []
    folder = common_folder(one.path for one in photographs)
    if film is None:
        _require_apart(out, photographs)
    names = relative_names([one.path for one in photographs], folder)
    rows, crs = _rows(options, names)
    cameras = camera_names(photographs, options.cameras)
    sigma = options.position_sigma
    if options.look:
        photographs, turned = with_right_halves(photographs)
        notes += turned
    gathered = gather(
        photographs, names, rows, cameras, options.gravity_sigma_deg, None if sigma is None else (sigma[0], sigma[1])
    )
    lenses = by_camera(gathered, _lenses(photographs, options))
    vertical = None if options.vertical == "auto" else Vertical[options.vertical.upper()]
    placement = place_all([one.place for one in gathered], options.crs or crs, vertical)
    gap, times = options.epoch_gap_hours, [one.photograph.time for one in gathered]
    epochs = () if gap is None else epochs_of(times, gap)
    water = Water(options.index_ratio, options.water_level, options.take_off_above_water, epochs)
    where = IMAGES if film is not None else _folder_name(folder, out)
    content = capture_content(where, gathered, lenses, placement, water)
    write_json(content, place / CAPTURE)
    told = None
    if pattern is not None:
        paths = [one.path for one in photographs]
        survey, told, about_boards = find_marks(pattern, options.board, paths, names, options.board_sigma, recorder)
        notes += about_boards
        if len(survey.control_names):
            write_survey(survey, place / SURVEY)
    left_out = {_shown(path, folder): reason for path, reason in selection.left_out.items()}
    report: dict[str, Any] = {
        "format": REPORT_FORMAT,
        **{f"{path.stem}_sha256": _digest(path) for path in (place / CAPTURE, place / SURVEY) if path.is_file()},
        "files": [*(path.relative_to(place).as_posix() for path in sorted(place.rglob("*.*"))), REPORT],
        "out": str(out),
        "folder": str(folder if film is None else out / IMAGES),
        **found(content, gathered, lenses, placement),
        "marks": told,
        "left_out": left_out,
        "notes": [*notes, *oddities(gathered, lenses, listing.films)],
    }
    write_json(report, place / REPORT)
    return report


def _film(options: ImportOptions, listing: Listing) -> Path | None:
    """The film that is imported, where it is the only file that was named."""
    if listing.pictures or len(listing.films) != 1 or len(options.sources) != 1:
        return None
    return listing.films[0] if Path(options.sources[0]).expanduser().is_file() else None


def _frames(film: Path, place: Path, options: ImportOptions, recorder: Recorder) -> dict[Path, float]:
    """Frames of a film, written with their times; and those times in seconds."""
    frames = take_frames(film, place / IMAGES, options.film.overlap, options.film.most, recorder)
    write_times(frames, place / TIMES)
    return {path: look.seconds for path, look in frames}


def _select(listing: Listing, options: ImportOptions, recorder: Recorder) -> _Selection:
    left_out = {path: reason for path, reason in listing.others.items() if reason}
    read: list[Photograph] = []
    pictures = listing.pictures
    for path in recorder.track(pictures, len(pictures), "reading", "photograph"):
        try:
            read.append(read_photograph(path))
        except CaptureError as error:
            left_out[path] = str(error).removeprefix(f"{path} ")
    reasons = left_out_by_kind([one.kind for one in read])
    left_out |= {one.path: reason for one, reason in zip(read, reasons, strict=True) if reason}
    used = [one for one, reason in zip(read, reasons, strict=True) if not reason]
    if options.look:
        reasons = useless(look_at([one.path for one in used]))
        left_out |= {one.path: reason for one, reason in zip(used, reasons, strict=True) if reason}
        used = [one for one, reason in zip(used, reasons, strict=True) if not reason]
    if len(used) < 2:
        raise CaptureError(_too_few(options, used, left_out, listing))
    return _Selection(used, left_out)


def _too_few(options: ImportOptions, used: Sequence[Photograph], left_out: Mapping[Path, str], listing: Listing) -> str:
    where, count = ", ".join(options.sources), len(used)
    found = f"photos is {where}, where {count or 'no'} photograph{'' if count == 1 else 's'} can be used"
    if listing.films and not listing.pictures:
        return f"{found}; for the frames of a film name the file: photos={listing.films[0]}"
    for path, reason in left_out.items():
        return f"{found}, but a reconstruction needs two; left out {len(left_out)}, as {path.name}: {reason}"
    return f"{found}, but a reconstruction needs two; name the folder with the photographs"


def _require_apart(out: Path, photographs: Iterable[Photograph]) -> None:
    for folder in {real_path(one.path.parent) for one in photographs}:
        if out == folder or folder in out.parents:
            raise OutRefusedError(f"out is {out}, where photographs lie; name a folder outside theirs")


def _rows(options: ImportOptions, names: Sequence[str]) -> tuple[Sequence[Row | None], str | None]:
    """Of each photograph what a table states, and the reference system that it names."""
    if options.table is None:
        return [None] * len(names), None
    table = read_table(Path(options.table).expanduser())
    return table.of(names), table.crs


def _lenses(photographs: Sequence[Photograph], options: ImportOptions) -> list[Lens]:
    """Of each photograph: the user's word goes before that of the file."""
    lenses = [one.lens for one in photographs]
    if options.camera is not None:
        camera = read_camera(Path(options.camera).expanduser())
        lenses = [camera.for_size(one.size) for one in photographs]
    elif options.focal_px is not None:
        known = [centered(options.focal_px, *one.size, FOCAL_BY_USER_SIGMA, "focal_px") for one in photographs]
        lenses = [replace(own, focal=new.focal, sigma=new.sigma, source=new.source)
                  for own, new in zip(lenses, known, strict=True)]  # fmt: skip
    sigma = options.focal_sigma
    return lenses if sigma is None else [replace(lens, sigma=sigma) for lens in lenses]


def _folder_name(folder: Path, out: Path) -> str:
    """Relative where both lie in one project, so that it can be moved; else absolute."""
    beside = out.parent in (folder, *folder.parents)
    return Path(os.path.relpath(folder, out)).as_posix() if beside else folder.as_posix()


def _shown(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
