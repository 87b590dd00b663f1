"""A survey: what was measured on site, beside the photographs, and how well."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchrefrac.checks import TorchrefracError


class SurveyError(TorchrefracError, ValueError):
    """The survey cannot be used; the message names the file and the field."""


Matrix = list[list[float]]


@dataclass(frozen=True)
class SurveyedImage:
    """down: unit vector and sigma in radians. height: value and sigma. center: position and information (3, 3)."""

    down: tuple[list[float], float] | None = None
    height: tuple[float, float] | None = None
    center: tuple[list[float], Matrix] | None = None


@dataclass(frozen=True)
class SurveyedMark:
    """pixels by name of image; known: position and information (3, 3); waterline: sigma, where it lies in the water."""

    pixels: dict[str, list[float]]
    known: tuple[list[float], Matrix] | None = None
    waterline: float | None = None

    @property
    def is_placed(self) -> bool:
        """Whether it is observed at least twice, or once beside a known position."""
        return len(self.pixels) >= (2 if self.known is None else 1)


@dataclass(frozen=True)
class ScaleBar:
    """The distance between two marks, by their names."""

    start: str
    end: str
    length: float
    sigma: float


@dataclass(frozen=True)
class Survey:
    """Measurements of the images of an alignment and of marks seen in them, resolved against the names of its images.

    Every kind of measurement is a flat table of its own, float64 and int64, and any of them may be empty. Indices named
    `*_image` and `mark_image` point into `names`, those named `mark` and `*_mark` into `mark_names`. Lengths are in the
    unit of the alignment, positions in its frame, angles in radians, pixels in COLMAP's convention. A `sigma` is a
    standard deviation, an `information` the inverse of a covariance.

    Images: unit vectors down_in_cam (a, 3) with the angle down_sigma (a) by which they are expected to err; height (b)
    of the camera centre above its water plane, along the normal of that plane, with height_sigma (b); camera centres
    center (c, 3) with center_information (c, 3, 3).

    Marks: k points that somebody has pointed at in the images, q times in all: mark_image and mark (q), sorted by mark,
    mark_pixels (q, 2). Each is observed at least twice, or once where its position is known, as it is for p of them:
    known_mark (p), known_position (p, 3), known_information (p, 3, 3). w of them lie in the water surface:
    waterline_mark (w), waterline_sigma (w) along its normal. s distances between marks are known: bar_from, bar_to,
    bar_length and bar_sigma (s).

    skipped: images that the survey names and the alignment does not have; nothing measured of them is in the tables.
    skipped_marks: marks that could not be placed without those images; they and their scale bars are not in the tables.
    """

    names: tuple[str, ...]
    down_in_cam: Tensor
    down_sigma: Tensor
    down_image: Tensor
    height: Tensor
    height_sigma: Tensor
    height_image: Tensor
    center: Tensor
    center_information: Tensor
    center_image: Tensor
    mark_names: tuple[str, ...]
    mark_image: Tensor
    mark: Tensor
    mark_pixels: Tensor
    known_mark: Tensor
    known_position: Tensor
    known_information: Tensor
    waterline_mark: Tensor
    waterline_sigma: Tensor
    bar_from: Tensor
    bar_to: Tensor
    bar_length: Tensor
    bar_sigma: Tensor
    skipped: tuple[str, ...] = ()
    skipped_marks: tuple[str, ...] = ()

    @classmethod
    def empty(cls, names: Sequence[str]) -> "Survey":
        """Nothing was measured of these images."""
        return resolve({}, {}, [], names)


def resolve(
    images: Mapping[str, SurveyedImage],
    marks: Mapping[str, SurveyedMark],
    bars: Sequence[ScaleBar],
    names: Sequence[str],
) -> Survey:
    """The survey of an alignment with images `names`; what is measured of other images is skipped (see `Survey`).

    Tables keep the order of their arguments. The ends of `bars` must be among `marks`.
    """
    index = {name: i for i, name in enumerate(names)}
    mentioned = dict.fromkeys((*images, *(image for mark in marks.values() for image in mark.pixels)))
    seen = {
        name: replace(mark, pixels={image: pixel for image, pixel in mark.pixels.items() if image in index})
        for name, mark in marks.items()
    }
    placed = {name: mark for name, mark in seen.items() if mark.is_placed}
    number = {name: i for i, name in enumerate(placed)}
    here = [(index[name], image) for name, image in images.items() if name in index]
    down = [(i, *image.down) for i, image in here if image.down is not None]
    height = [(i, *image.height) for i, image in here if image.height is not None]
    center = [(i, *image.center) for i, image in here if image.center is not None]
    observations = [(index[i], number[name], uv) for name, mark in placed.items() for i, uv in mark.pixels.items()]
    known = [(number[name], *mark.known) for name, mark in placed.items() if mark.known is not None]
    waterline = [(number[name], mark.waterline) for name, mark in placed.items() if mark.waterline is not None]
    bars = [bar for bar in bars if bar.start in placed and bar.end in placed]
    return Survey(
        names=tuple(names),
        down_in_cam=_floats((row[1] for row in down), 3),
        down_sigma=_floats(row[2] for row in down),
        down_image=_longs(row[0] for row in down),
        height=_floats(row[1] for row in height),
        height_sigma=_floats(row[2] for row in height),
        height_image=_longs(row[0] for row in height),
        center=_floats((row[1] for row in center), 3),
        center_information=_floats((row[2] for row in center), 3, 3),
        center_image=_longs(row[0] for row in center),
        mark_names=tuple(placed),
        mark_image=_longs(row[0] for row in observations),
        mark=_longs(row[1] for row in observations),
        mark_pixels=_floats((row[2] for row in observations), 2),
        known_mark=_longs(row[0] for row in known),
        known_position=_floats((row[1] for row in known), 3),
        known_information=_floats((row[2] for row in known), 3, 3),
        waterline_mark=_longs(row[0] for row in waterline),
        waterline_sigma=_floats(row[1] for row in waterline),
        bar_from=_longs(number[bar.start] for bar in bars),
        bar_to=_longs(number[bar.end] for bar in bars),
        bar_length=_floats(bar.length for bar in bars),
        bar_sigma=_floats(bar.sigma for bar in bars),
        skipped=tuple(name for name in mentioned if name not in index),
        skipped_marks=tuple(name for name in marks if name not in placed),
    )


def _floats(rows: Iterable[Any], *shape: int) -> Tensor:
    return torch.tensor(list(rows), dtype=torch.float64).reshape(-1, *shape)


def _longs(rows: Iterable[int]) -> Tensor:
    return torch.tensor(list(rows), dtype=torch.long)
