"""A survey: what was measured on site, beside the photographs, and how well."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.geometry import Rigid, rotate
from torchrefrac.scene.capture import Capture
from torchrefrac.scene.georeference import Georeference


def vertical() -> Float[Tensor, "3"]:
    """The unit vector z, which is up in every frame that is level."""
    return torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)


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
    it lies in the water surface. is_check: its position is only compared with what comes out."""

    pixels: dict[str, list[float]]
    known: tuple[list[float], Matrix] | None = None
    waterline: float | None = None
    is_check: bool = False

    @property
    def is_placed(self) -> bool:
        """Whether it is observed at least twice, or once beside a known position that takes part."""
        return len(self.pixels) >= (2 if self.known is None or self.is_check else 1)


@dataclass(frozen=True)
class ScaleBar:
    """The distance between two control points, by their names."""

    start: str
    end: str
    length: float
    sigma: float


@dataclass(frozen=True)
class WaterMark:
    """A place at which the water stood: its position, x and y None where only its height is known, and its sigma along
    the normal of the water. source: who says so, in words; several marks may have one. epoch: that of the photographs,
    by its name, where there are several."""

    source: str
    position: tuple[float | None, float | None, float]
    sigma: float
    epoch: str = ""


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
    between some are known (bars). Of check points the position is known, too, but takes no part in an adjustment.

    Levels: places in the water surface, with level_sigma along its normal; where not level_has_place, only the height
    counts. level: rows of level_sources, who says so, and of level_epochs, of which epoch ("": there is one).

    up: the vertical in its frame, a unit vector; z, unless the frame slopes with the water.

    skipped: images that the survey names and the scene does not have; nothing measured of them is in the tables.
    skipped_controls: points that could not be placed without those images; they and their scale bars are not in the
    tables. georeference: where the frame stands, if the survey says it.
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
    check_control: Int[Tensor, " k"]
    check_position: Float[Tensor, "k 3"]
    check_information: Float[Tensor, "k 3 3"]
    level_sources: tuple[str, ...]
    level_epochs: tuple[str, ...]
    level: Int[Tensor, " l"]
    level_position: Float[Tensor, "l 3"]
    level_has_place: Bool[Tensor, " l"]
    level_sigma: Float[Tensor, " l"]
    up: Float[Tensor, "3"] = field(default_factory=vertical)
    skipped: tuple[str, ...] = ()
    skipped_controls: tuple[str, ...] = ()
    georeference: Georeference | None = None

    @property
    def has_lengths(self) -> bool:
        """Whether anything in it gives a scene its scale."""
        several = len(self.center) > 1 or len(self.known_control) > 1
        return several or bool(len(self.height) or len(self.bar_length))

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
        return self.moved(Rigid(torch.eye(3, dtype=torch.float64), by * vertical()))

    def moved(self, motion: Rigid) -> "Survey":
        """The same in the frame to which a motion leads."""
        moved = {name: motion.apply(getattr(self, name)) for name in POSITIONS}
        return replace(self, **moved, **self._turned(motion.rotation))

    def _turned(self, turn: Float[Tensor, "3 3"]) -> dict[str, Float[Tensor, "..."]]:
        """What has directions, in a frame that is turned."""
        information = {name: turn @ getattr(self, name) @ turn.mT for name in INFORMATIONS}
        return {**information, "up": rotate(turn, self.up)}

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

    def without_water(self) -> "Survey":
        """The same without points on the waterline and levels, of a scene that knows nothing of the water."""
        dry = replace(self, waterline_control=self.waterline_control[:0], waterline_sigma=self.waterline_sigma[:0])
        return dry.without_levels()

    def without_levels(self) -> "Survey":
        """The same without any level of the water."""
        return self.of_levels(torch.zeros(len(self.level_sources), dtype=torch.bool))

    def of_levels(self, sources: Bool[Tensor, " s"]) -> "Survey":
        """The same with the levels of some of their sources alone."""
        rows, which = sources[self.level], sources.nonzero()[:, 0].tolist()
        return replace(
            self,
            level_sources=tuple(self.level_sources[i] for i in which),
            level_epochs=tuple(self.level_epochs[i] for i in which),
            level=(sources.cumsum(dim=0) - 1)[self.level[rows]],
            level_position=self.level_position[rows],
            level_has_place=self.level_has_place[rows],
            level_sigma=self.level_sigma[rows],
        )

    def with_levels(self, other: "Survey") -> "Survey":
        """The same with the levels of another survey."""
        return replace(self, **{name: getattr(other, name) for name in LEVELS})

    def placed(self, georeference: Georeference) -> "Survey":
        """The same, which has coordinates of a reference system, in a local frame there."""
        axis = self.level_position.new_tensor(georeference.origin[:2]).expand(len(self.level), 2)
        anywhere = torch.cat((axis, self.level_position[:, 2:]), dim=1)
        placed = replace(self, level_position=torch.where(self.level_has_place[:, None], self.level_position, anywhere))
        local = {name: georeference.local(getattr(placed, name)) for name in POSITIONS}
        return replace(placed, **local, **self._turned(georeference.level_from_local.mT), georeference=georeference)

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


LEVELS = ("level_sources", "level_epochs", "level", "level_position", "level_has_place", "level_sigma")
POSITIONS = ("center", "known_position", "check_position", "level_position")
"""The fields of a survey that hold places in its frame."""
INFORMATIONS = ("center_information", "known_information", "check_information")
"""And those that hold what is known of these along its axes."""


@dataclass(frozen=True, eq=False)
class Surveyed:
    """What became of a survey in the adjustment of a scene.

    stated: all of it, in the frame of the scene; used: what the scene was adjusted with. Of its ground control points:
    control, where they are, placed, whether they have a place, met, whether the rays of two of their pixels or more
    do, and sigma, the standard deviations of where they are along the axes, infinite where these are not known; of
    those with known positions: off, where the rays of their pixels meet less what is stated (zero where fewer than two
    meet); distance from what is stated, also in standard deviations of that, after the adjustment (infinitely many
    where not even their pixels fit there). check_off: as off, of check points. mistake: that explains why some
    positions did not fit, which were left out then, in a sentence; empty where there is none.
    """

    stated: Survey
    used: Survey
    control: Float[Tensor, "c 3"]
    placed: Bool[Tensor, " c"]
    met: Bool[Tensor, " c"]
    sigma: Float[Tensor, "c 3"]
    off: Float[Tensor, "p 3"]
    distance: Float[Tensor, " p"]
    deviations: Float[Tensor, " p"]
    check_off: Float[Tensor, "k 3"]
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
    water: Sequence[WaterMark] = (),
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
    positioned = [(number[name], point, *point.known) for name, point in placed.items() if point.known is not None]
    known, check = (
        [(i, *known) for i, point, *known in positioned if point.is_check is is_check] for is_check in (False, True)
    )
    sources = [*dict.fromkeys((mark.source, mark.epoch) for mark in water)]
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
        check_control=_longs(row[0] for row in check),
        check_position=_floats((row[1] for row in check), 3),
        check_information=_floats((row[2] for row in check), 3, 3),
        level_sources=tuple(source for source, _ in sources),
        level_epochs=tuple(epoch for _, epoch in sources),
        level=_longs(sources.index((mark.source, mark.epoch)) for mark in water),
        level_position=_floats(([x or 0.0 for x in mark.position] for mark in water), 3),
        level_has_place=torch.tensor([mark.position[0] is not None for mark in water], dtype=torch.bool),
        level_sigma=_floats(mark.sigma for mark in water),
        skipped=tuple(name for name in mentioned if name not in index),
        skipped_controls=tuple(name for name in controls if name not in placed),
    )


def _floats(rows: Iterable[Any], *shape: int) -> Float[Tensor, "n *shape"]:
    return torch.tensor(list(rows), dtype=torch.float64).reshape(-1, *shape)


def _longs(rows: Iterable[int]) -> Int[Tensor, " n"]:
    return torch.tensor(list(rows), dtype=torch.long)
