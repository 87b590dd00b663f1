"""What was measured on site, once all views have a place: positions of cameras (as of satellites) and of ground control
give the finished scene its place, its heading and its scale, or scale bars its scale alone; then all of it takes part
in the adjustment with its errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.bundle import Term
from torchrefrac.geometry import Rigid, Similarity, levelling, rotate
from torchrefrac.scene import Capture, Interfaces, Part, Scene, Survey, Surveyed
from torchrefrac.sfm.control import CLICK, survey_terms, with_control
from torchrefrac.sfm.frame import fix_frame, mean_level, transformed
from torchrefrac.sfm.positions import surveyed, with_meeting_points, without_contradicted
from torchrefrac.sfm.stated_places import StatedPlaces

FEWEST = 3


@dataclass(frozen=True, eq=False)
class SurveyFrame:
    """Of a scene whose points after the first `ties` are the ground control points of a survey: stated, all that was
    measured, in the frame of the scene; used: without what most others contradict; level: by how much the frame of the
    scene is higher than that of the survey; None: it is a frame of its own, in the unit of the survey. mistake: see
    `Surveyed`. Where the water slopes the frame is turned besides, by what is up in it."""

    stated: Survey
    used: Survey
    ties: int
    level: float | None = 0.0
    mistake: str = ""

    def lowered(self, by: float) -> "SurveyFrame":
        """The same with the water so much higher."""
        level = None if self.level is None else self.level + by
        return replace(self, stated=self.stated.lowered(by), used=self.used.lowered(by), level=level)

    @property
    def survey_from_world(self) -> Rigid:
        """From the frame of the scene to that of the survey, which is level."""
        return _above_water(self.used.up, self.level or 0.0)

    def with_water_at_zero(self, scene: Scene) -> tuple["SurveyFrame", Scene]:
        """The same where the one interface of a scene, which slopes, is z = 0; and the scene there."""
        survey_from_old = self.survey_from_world
        plane = scene.interfaces.planes.in_frame(survey_from_old.rotation, survey_from_old.center)
        (normal,), (height,) = plane.normal_like(scene.points), plane.offset / plane.normal_like(scene.points)[:, 2]
        survey_from_new = _above_water(normal * normal.new_tensor((-1.0, -1.0, 1.0)), float(height))
        change = survey_from_new.inverse @ survey_from_old
        shift = -rotate(change.rotation, change.center)
        turned = transformed(scene, Similarity(torch.ones_like(height), change.rotation, shift))
        frame = replace(self, stated=self.stated.moved(change), used=self.used.moved(change), level=float(height))
        level = Interfaces.level(scene.index_ratio)
        water = replace(scene.interfaces, normal=level.normal, offset=level.offset)
        return frame, replace(turned, interfaces=water)

    def terms(self, part: Part) -> Sequence[Term]:
        """What was measured of a part of the scene."""
        return survey_terms(self.used, part, self.ties)

    def lengths(self, of_ties: int) -> Int[Tensor, " n"]:
        """Observations that points need: so many, and control points 2, or 1 where their position is known."""
        length = torch.full((self.ties + len(self.used.control_names),), of_ties)
        length[self.ties :] = 2
        return length.index_fill(0, self.ties + self.used.known_control, 1)

    def with_levels(self, sources: Bool[Tensor, " s"]) -> "SurveyFrame":
        """The same with the levels that some of the sources state."""
        return replace(self, used=self.used.with_levels(self.stated.of_levels(sources)))

    def parted(self, scene: Scene) -> tuple[Scene, Surveyed]:
        """The scene without its ground control points, and what became of the survey; its assessment is of all its
        points."""
        tied, ties = scene.observations.point < self.ties, torch.arange(self.ties)
        tied_scene = replace(
            scene,
            points=scene.points[ties],
            colors=scene.colors[ties],
            placed=scene.placed[ties],
            dry=None if scene.dry is None else scene.dry[ties],
            observations=scene.observations[tied],
            accepted=scene.accepted[tied],
        )
        return tied_scene, replace(surveyed(scene, self.stated, self.used), mistake=self.mistake)


def _above_water(up: Float[Tensor, "3"], height: float) -> Rigid:
    """To a level frame from one in which the vertical is `up`, and whose origin is so much higher."""
    rotation = levelling(-up)
    return Rigid(rotation, -height * rotation[2])


class KnownPlaces(NamedTuple):
    """A scene with the ground control points of a survey as its last points, those of the places that the survey states
    which the scene has, and the rotation that puts its vertical upright."""

    scene: Scene
    places: StatedPlaces
    level: Float[Tensor, "3 3"]

    def survey_from_scene(self, capture: Capture) -> Similarity | None:
        """By these places, with the vertical of the water, or of the gravity measured, where it is known. None where
        they do not determine it, or are stated by mistake."""
        measured = self.scene.views.registered & capture.down_sigma.isfinite()
        level = self.level if self.scene.interfaces.stand_in_world or bool(measured.any()) else None
        if not len(self.places) or self.places.mistake(level) is not None:
            return None
        found = self.places.similarity() if level is None else self.places.level_similarity(level)
        return None if found is None else found[0]


def known_places(scene: Scene, capture: Capture, survey: Survey, pixel_sigma: float = CLICK) -> KnownPlaces:
    """The places that a survey states of a scene, through water the vertical of which counts, and without refraction
    that of the gravity measured. pixel_sigma: of keypoints."""
    every = with_control(scene, survey, pixel_sigma)
    if len(survey.control_names):
        every = with_meeting_points(every, torch.arange(len(every.points)) >= len(scene.points))
    places = StatedPlaces.of(every, survey)
    upright = scene.interfaces.stand_in_world
    level = torch.eye(3, dtype=torch.float64) if upright else mean_level(scene, capture)
    return KnownPlaces(every, places[places.known], level)


def placed_by_survey(
    scene: Scene, capture: Capture, survey: Survey, pixel_sigma: float = CLICK
) -> tuple[Scene, SurveyFrame] | None:
    """The scene in the frame of the positions of a survey, with its ground control points as the last points; in it the
    water stays the plane z = 0. Where only scale bars are known, or points on the waterline, it stays where it is, but
    has their unit.

    None where nothing is known of that, or too few positions that lie too close together for their errors. Through
    water the vertical of the scene counts, and without refraction that of the gravity measured: heading, scale and
    place follow from a horizontal similarity, whichever few positions are wrong, and the height from the mean.
    pixel_sigma: of keypoints, as the images show it.
    """
    ties, refractive = len(scene.points), scene.interfaces.stand_in_world
    survey = survey if refractive else survey.without_water()
    every, places, level = known_places(scene, capture, survey, pixel_sigma)
    mistake = places.mistake(level)
    if mistake is not None:
        survey = survey.without(*_all_positions(survey, cameras=mistake.of_cameras))
        places = places[~places.of_control & ~torch.tensor(mistake.of_cameras)]
    why = "" if mistake is None else mistake.sentence
    found = places.level_similarity(level) if len(places) >= FEWEST else None
    if found is None:
        return _scaled(every, capture, survey, ties, why)
    change, height = found[0], float(found[0].translation[2]) if refractive else 0.0
    lowered = survey.lowered(height)
    shift = change.translation - change.translation.new_tensor((0.0, 0.0, height))
    every = transformed(every, replace(change, translation=shift))
    frame = SurveyFrame(lowered, without_contradicted(every, lowered).without_levels(), ties, height, why)
    return _with_known(every, frame), frame


def _scaled(
    scene: Scene, capture: Capture, survey: Survey, ties: int, mistake: str
) -> tuple[Scene, SurveyFrame] | None:
    """The scene in a frame of its own, in the unit of the scale bars, with what does not depend on a frame."""
    if len(survey.known_control) and not mistake:
        mistake = f"positions of the survey do not say where the scene is: give {FEWEST} or more that are apart"
    survey = survey.without(*_all_positions(survey, cameras=True))
    if not (mistake or len(survey.bar_length) or len(survey.waterline_control) or survey.level_sources):
        return None
    scene = fix_frame(scene, capture)
    apart = (scene.points[ties + survey.bar_to] - scene.points[ties + survey.bar_from]).norm(dim=-1)
    known = scene.placed[ties + survey.bar_to] & scene.placed[ties + survey.bar_from]
    if bool(known.any()):
        scale = (survey.bar_length / apart)[known].median()
        scene = transformed(scene, Similarity(scale, torch.eye(3).to(scale), scale.new_zeros(3)))
    return scene, SurveyFrame(survey, survey.without_levels(), ties, None, mistake)


def _all_positions(survey: Survey, cameras: bool) -> tuple[Bool[Tensor, " c"], Bool[Tensor, " p"]]:
    """Masks of the positions of all ground control points, and of all cameras where these are wanted, too."""
    centers = torch.full((len(survey.center),), cameras)
    return centers, torch.ones(len(survey.known_control), dtype=torch.bool)


def _with_known(scene: Scene, frame: SurveyFrame) -> Scene:
    """With control points that a single view sees where they are stated to be."""
    ids = frame.ties + frame.used.known_control
    alone = (scene.sightings()[ids] == 1) & ~scene.placed[ids]
    points = scene.points.index_copy(0, ids[alone], frame.used.known_position[alone])
    return replace(scene, points=points, placed=scene.placed.index_fill(0, ids[alone], True))
