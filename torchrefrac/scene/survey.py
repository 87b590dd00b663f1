"""A survey: what was measured on site, beside the photographs, and how well."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.scene.capture import Capture


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
class ControlPoint:
    """A ground control point. pixels by name of image; known: position and information (3, 3); waterline: sigma, where
    it lies in the water surface."""

    pixels: dict[str, list[float]]
    known: tuple[list[float], Matrix] | None = None
    waterline: float | None = None

    @property
    def is_placed(self) -> bool:
        """Whether it is observed at least twice, or once beside a known position."""
        return len(self.pixels) >= (2 if self.known is None else 1)


@dataclass(frozen=True)
class ScaleBar:
    """The distance between two control points, by their names."""

    start: str
    end: str
    length: float
    sigma: float


@dataclass(frozen=True)
class Survey:
    """Measurements of the views of a scene and of ground control points seen in them, resolved against their names.

    Every kind of measurement is a flat table of its own, float64 and int64, and any of them may be empty. Indices named
    `*_image` point into `names`, those named `control` and `*_control` into `control_names`. Lengths are in the unit of
    the scene, positions in its frame, angles in radians, pixels in COLMAP's convention. A `sigma` is a standard
    deviation, an `information` the inverse of a covariance.

    Images: unit vectors down_in_cam with the angle down_sigma by which they are expected to err; height of the camera
    centre above its interface, along the normal of that plane; camera centres.

    Control: points that somebody has pointed at in the images, sorted by point. Each is observed at least twice, or
    once where its position is known. Some lie in the water surface, with waterline_sigma along its normal; distances
    between some are known (bars).

    skipped: images that the survey names and the scene does not have; nothing measured of them is in the tables.
    skipped_controls: points that could not be placed without those images; they and their scale bars are not in the
    tables.
    """

    names: tuple[str, ...]
    down_in_cam: Float[Tensor, "a 3"]
    down_sigma: Float[Tensor, " a"]
    down_image: Int[Tensor, " a"]
    height: Float[Tensor, " b"]
    height_sigma: Float[Tensor, " b"]
    height_image: Int[Tensor, " b"]
    center: Float[Tensor, "c 3"]
    center_information: Float[Tensor, "c 3 3"]
    center_image: Int[Tensor, " c"]
    control_names: tuple[str, ...]
    control_image: Int[Tensor, " q"]
    control: Int[Tensor, " q"]
    control_pixels: Float[Tensor, "q 2"]
    known_control: Int[Tensor, " p"]
    known_position: Float[Tensor, "p 3"]
    known_information: Float[Tensor, "p 3 3"]
    waterline_control: Int[Tensor, " w"]
    waterline_sigma: Float[Tensor, " w"]
    bar_from: Int[Tensor, " s"]
    bar_to: Int[Tensor, " s"]
    bar_length: Float[Tensor, " s"]
    bar_sigma: Float[Tensor, " s"]
    skipped: tuple[str, ...] = ()
    skipped_controls: tuple[str, ...] = ()

    @classmethod
    def empty(cls, names: Sequence[str]) -> "Survey":
        """Nothing was measured of these images."""
        return resolve({}, {}, [], names)

    def loosened(self, factor: float) -> "Survey":
        """The same with sigmas of positions, of cameras and of control points, that are `factor` times as large."""
        weight = factor**-2
        return replace(
            self,
            center_information=weight * self.center_information,
            known_information=weight * self.known_information,
        )

    def lowered(self, by: float) -> "Survey":
        """The same in a frame whose origin is so much higher."""
        down = self.center.new_tensor((0.0, 0.0, by))
        return replace(self, center=self.center - down, known_position=self.known_position - down)

    def beside(self, capture: Capture) -> "Survey":
        """The same for a capture of the same images that already has the gravity of it: without gravity, and with the
        positions that the capture states of more images."""
        known = capture.position_sigma.isfinite().all(dim=-1)
        known[self.center_image] = False
        rows = known.nonzero()[:, 0]
        image = torch.cat((self.center_image, rows))
        order = image.argsort()
        information = torch.diag_embed(1.0 / capture.position_sigma[rows].square())
        return replace(
            self,
            down_in_cam=self.down_in_cam[:0],
            down_sigma=self.down_sigma[:0],
            down_image=self.down_image[:0],
            center=torch.cat((self.center, capture.position[rows]))[order],
            center_information=torch.cat((self.center_information, information))[order],
            center_image=image[order],
        )

    def without_waterline(self) -> "Survey":
        """The same without points on the waterline, of a scene that knows nothing of the water."""
        return replace(self, waterline_control=self.waterline_control[:0], waterline_sigma=self.waterline_sigma[:0])

    def without(self, centers: Bool[Tensor, " c"], control: Bool[Tensor, " p"]) -> "Survey":
        """The same without some of the camera centres and some of the known positions of control points."""
        return replace(
            self,
            center=self.center[~centers],
            center_information=self.center_information[~centers],
            center_image=self.center_image[~centers],
            known_control=self.known_control[~control],
            known_position=self.known_position[~control],
            known_information=self.known_information[~control],
        )


@dataclass(frozen=True, eq=False)
class Surveyed:
    """What became of a survey in the adjustment of a scene.

    stated: all of it, in the frame of the scene; used: what the scene was adjusted with. Of its ground control points:
    control, where they are, and placed, whether they have a place; of those with known positions: off, where the rays
    of their pixels meet less what is stated (zero where fewer than two meet); distance from what is stated, also in
    standard deviations of that, after the adjustment (infinitely many where not even their pixels fit there). mistake:
    that explains why some positions did not fit, which were left out then, in a sentence; empty where there is none.
    """

    stated: Survey
    used: Survey
    control: Float[Tensor, "c 3"]
    placed: Bool[Tensor, " c"]
    off: Float[Tensor, "p 3"]
    distance: Float[Tensor, " p"]
    deviations: Float[Tensor, " p"]
    mistake: str = ""


def with_measured(capture: Capture, survey: Survey) -> Capture:
    """The capture with the gravity, the heights and the positions that a survey of the same images has of them."""
    if not (len(survey.down_image) or len(survey.height_image) or len(survey.center_image)):
        return capture
    down, height, center = survey.down_image, survey.height_image, survey.center_image
    sigma = torch.linalg.inv(survey.center_information).diagonal(dim1=-2, dim2=-1).sqrt()
    return replace(
        capture,
        down_in_cam=capture.down_in_cam.index_copy(0, down, survey.down_in_cam),
        down_sigma=capture.down_sigma.index_copy(0, down, survey.down_sigma),
        has_gravity=capture.has_gravity or bool(len(down)),
        height=capture.height.index_copy(0, height, survey.height),
        has_height=capture.has_height.index_fill(0, height, True),
        height_sigma=capture.height_sigma.index_copy(0, height, survey.height_sigma),
        position=capture.position.index_copy(0, center, survey.center),
        position_sigma=capture.position_sigma.index_copy(0, center, sigma),
    )


def resolve(
    images: Mapping[str, SurveyedImage],
    controls: Mapping[str, ControlPoint],
    bars: Sequence[ScaleBar],
    names: Sequence[str],
) -> Survey:
    """The survey of a scene with images `names`; what is measured of other images is skipped (see `Survey`).

    Tables have the order of their arguments. The ends of `bars` must be among `controls`.
    """
    index = {name: i for i, name in enumerate(names)}
    mentioned = dict.fromkeys((*images, *(image for point in controls.values() for image in point.pixels)))
    seen = {
        name: replace(point, pixels={image: pixel for image, pixel in point.pixels.items() if image in index})
        for name, point in controls.items()
    }
    placed = {name: point for name, point in seen.items() if point.is_placed}
    number = {name: i for i, name in enumerate(placed)}
    here = [(index[name], image) for name, image in images.items() if name in index]
    down = [(i, *image.down) for i, image in here if image.down is not None]
    height = [(i, *image.height) for i, image in here if image.height is not None]
    center = [(i, *image.center) for i, image in here if image.center is not None]
    observations = [(index[i], number[name], uv) for name, point in placed.items() for i, uv in point.pixels.items()]
    known = [(number[name], *point.known) for name, point in placed.items() if point.known is not None]
    waterline = [(number[name], point.waterline) for name, point in placed.items() if point.waterline is not None]
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
        control_names=tuple(placed),
        control_image=_longs(row[0] for row in observations),
        control=_longs(row[1] for row in observations),
        control_pixels=_floats((row[2] for row in observations), 2),
        known_control=_longs(row[0] for row in known),
        known_position=_floats((row[1] for row in known), 3),
        known_information=_floats((row[2] for row in known), 3, 3),
        waterline_control=_longs(row[0] for row in waterline),
        waterline_sigma=_floats(row[1] for row in waterline),
        bar_from=_longs(number[bar.start] for bar in bars),
        bar_to=_longs(number[bar.end] for bar in bars),
        bar_length=_floats(bar.length for bar in bars),
        bar_sigma=_floats(bar.sigma for bar in bars),
        skipped=tuple(name for name in mentioned if name not in index),
        skipped_controls=tuple(name for name in controls if name not in placed),
    )


def _floats(rows: Iterable[Any], *shape: int) -> Float[Tensor, "n *shape"]:
    return torch.tensor(list(rows), dtype=torch.float64).reshape(-1, *shape)


def _longs(rows: Iterable[int]) -> Int[Tensor, " n"]:
    return torch.tensor(list(rows), dtype=torch.long)
