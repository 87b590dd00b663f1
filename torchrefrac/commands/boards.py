"""The boards and tags of the options, looked for in photographs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchrefrac.config.importing import BoardOptions, ImportOptions
from torchrefrac.files.metadata.board_survey import found_on, survey_of
from torchrefrac.files.metadata.boards import Charuco, Chessboard, Pattern, Sight, Tags
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Survey
from torchrefrac.scene.capture import CaptureError


class Marks(NamedTuple):
    """What boards and tags give: a survey, what is told of them, and what is odd."""

    survey: Survey
    told: dict[str, Any]
    notes: list[str]


def board_of(options: BoardOptions) -> Charuco | Chessboard:
    """The flat board. Raises CaptureError for a dictionary without enough markers."""
    columns, rows = options.columns or 0, options.rows or 0
    square, marker = options.side("square") or 0.0, options.side("marker")
    if options.board == "chessboard":
        return Chessboard(columns, rows, square)
    return Charuco(columns, rows, square, marker, options.dictionary)


def pattern_of(options: ImportOptions) -> Pattern | None:
    """What lies in the scene, its sides in m. Raises CaptureError for a board that cannot be told from itself turned
    upside down, and for a family or dictionary that is not known."""
    if options.board == "none":
        return None
    if options.board == "apriltag":
        return Tags(options.family, options.side("tag") or 0.0)
    board = board_of(options)
    if isinstance(board, Chessboard) and board.looks_the_same_turned:
        raise CaptureError(
            f"a chessboard of {board.columns} x {board.rows} inner corners looks the same upside down, so that nobody "
            "knows which corner is which; take an odd and an even number, or a charuco board"
        )
    return board


def find_marks(
    pattern: Pattern, kind: str, paths: Sequence[Path], names: Sequence[str], sigma: float, recorder: Recorder
) -> Marks:
    """What photographs show of boards or tags."""
    sights: dict[str, Sight] = {
        name: pattern.find(path)
        for name, path in zip(names, recorder.track(paths, len(paths), "looking for boards", "photograph"), strict=True)
    }
    certain = {name: sight.certain for name, sight in sights.items()}
    survey = survey_of(certain, sigma)
    told = {
        "kind": kind,
        "photographs": sum(bool(seen) for seen in certain.values()),
        "found": found_on(certain),
        "corners": len(survey.control_names),
        "observations": len(survey.control),
        "scale_bars": len(survey.bar_length),
    }
    return Marks(survey, told, [*_twice(sights), *([] if len(survey.control_names) else [_nothing(told)])])


def _twice(sights: dict[str, Sight]) -> list[str]:
    """A sentence on each board or tag that photographs show twice."""
    images: dict[str, list[str]] = {}
    for image, sight in sights.items():
        for name in sight.twice:
            images.setdefault(name, []).append(image)
    return [
        f"{name} is seen more than once in {_some(where)}: nobody knows which is which, so it was left out there; lay "
        "out each only once"
        for name, where in sorted(images.items())
    ]


def _nothing(told: dict[str, Any]) -> str:
    if not told["photographs"]:
        return f"no {told['kind']} was found in any photograph: check its options, or leave out board="
    return f"no corner of a {told['kind']} was found in two photographs, so that there is no survey of them"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
