"""What files of surveyors have in common: ground control points with their positions and clicks, and how they count."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from torchrefrac.files.fields import FARTHEST, MEGABYTE, MOST_MEGABYTES
from torchrefrac.files.metadata.xmp import as_number
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.survey import ControlPoint, Matrix, ScaleBar, SurveyedImage, WaterMark

SIGMA = (0.02, 0.03)
"""Horizontal and vertical, m, of control points whose file states none: as of satellites with corrections."""
CHECK = "check"
"""How the names of points begin that are only compared."""


@dataclass(frozen=True)
class Stated:
    """What a file of a survey says, before it is resolved; crs: the reference system of its positions, where it says
    that."""

    controls: Mapping[str, ControlPoint]
    images: Mapping[str, SurveyedImage] = field(default_factory=dict)
    bars: Sequence[ScaleBar] = ()
    water: Sequence[WaterMark] = ()
    crs: str | None = None

    def of_images(self, names: Sequence[str]) -> "Stated":
        """With clicks in images by the names that these have here, whose case may differ."""
        known = {name.lower(): name for name in names} | {name: name for name in names}

        def named(image: str) -> str:
            return known.get(image) or known.get(image.lower()) or image

        clicks = {name: {named(image): at for image, at in of.pixels.items()} for name, of in self.controls.items()}
        return replace(self, controls={name: replace(of, pixels=clicks[name]) for name, of in self.controls.items()})


def text_lines(path: Path, what: str) -> list[tuple[int, str]]:
    """The lines of a text that say something, with their numbers. Raises CaptureError where there are none."""
    if not path.is_file():
        raise CaptureError(f"{path} does not exist, but must be {what}")
    if path.stat().st_size > MOST_MEGABYTES * MEGABYTE:
        raise CaptureError(f"{path} has more than {MOST_MEGABYTES} MB; is it the right file?")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CaptureError(f"{path} is no text in UTF-8, but must be {what}") from None
    said = [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]
    if not said:
        raise CaptureError(f"{path} is empty, but must be {what}")
    return said


def numbers_of(texts: Sequence[str], names: Sequence[str], where: str) -> list[float]:
    """Numbers that stand in a row as `names`. Raises CaptureError for what is none."""
    found = []
    for text, name in zip(texts, names, strict=True):
        value = as_number(text)
        if value is None or abs(value) > FARTHEST:
            raise CaptureError(f"{where}: {name} is {text[:40]!r}, but must be a number")
        found.append(value)
    return found


def known_position(position: Sequence[float], sigma: tuple[float, float] = SIGMA) -> tuple[list[float], Matrix]:
    """A position and its information, of standard deviations horizontally and in height."""
    x, y, z = (one**-2 for one in (sigma[0], sigma[0], sigma[1]))
    return list(position), [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]]


def is_check(name: str) -> bool:
    """Whether its name makes a point one that is only compared."""
    return name.lower().startswith(CHECK)
