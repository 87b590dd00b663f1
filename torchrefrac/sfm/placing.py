"""A model that stands in a frame of its own, brought into that of a survey before it is adjusted with it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import Similarity, levelling, so3_log
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Scene, Survey, SurveyError
from torchrefrac.sfm.control import with_control
from torchrefrac.sfm.frame import moved, transformed
from torchrefrac.sfm.gravity import unlikely
from torchrefrac.sfm.positions import with_meeting_points
from torchrefrac.sfm.stated_places import FEWEST, FEWEST_LEVEL, StatedPlaces
from torchrefrac.sfm.vertical import mean_vertical

CLOSER = 3.0
"""Times that places must come closer to where they are stated to be: what is left of images that know nothing of the
water no similarity takes away."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A scene in the frame of a survey, and the similarity that brought it there: None where it stood there already, or
    nothing says where it should."""

    scene: Scene
    change: Similarity | None = None

    def shift(self, given: Scene) -> float:
        """By how much the middle of the cameras of the `given` scene moved, in length units of the survey."""
        middle = given.views.center.mean(dim=0)
        return 0.0 if self.change is None else float((self.change.apply(middle) - middle).norm())

    @property
    def turn_deg(self) -> float:
        """By how much the scene was turned."""
        return 0.0 if self.change is None else float(so3_log(self.change.rotation).norm().rad2deg())


def placed_in_survey(
    scene: Scene, survey: Survey, recorder: Recorder | None = None, water_is_in_place: bool = False
) -> Placed:
    """The scene in the frame of the positions that a survey states, of cameras and of ground control points, if it is
    farther off than their errors explain and a similarity brings most of them there.

    Its interfaces go along, unless the water is in place already, as one that is level in the frame of the survey; then
    ground control points are at first seen as if there was none. The similarity is robust: three positions or more that
    are not on a line, or two where the survey has gravity, or water that goes along shows what is level. Raises
    SurveyError where x and y are exchanged, control points and cameras are in different frames, or the scene is
    elsewhere and the positions do not say where it should be.
    """
    as_it_stands = _places(scene, survey)
    usual = unlikely(len(as_it_stands), 3)
    if len(as_it_stands) and float(as_it_stands.deviations().max()) <= usual:
        return Placed(scene)
    down, air = mean_down(scene, survey), torch.ones_like(scene.interfaces.index_ratio)
    if down is None and scene.interfaces.stand_in_world and not water_is_in_place:
        down = -scene.interfaces.normal[0]
    level = None if down is None else levelling(down)
    dry = replace(scene, interfaces=replace(scene.interfaces, index_ratio=air))
    places = _places(dry if water_is_in_place else scene, survey)
    if not len(places):
        return Placed(scene)
    if mistake := places.mistake(level):
        raise SurveyError(mistake.sentence)
    off = float(as_it_stands.deviations().median()) if len(as_it_stands) == len(places) else torch.inf
    if off <= usual:
        return Placed(scene)
    change = places.best(level, usual)
    if change is None:
        _require_near(scene, places, level is not None)
        return Placed(scene)
    placed = Placed((transformed if water_is_in_place else moved)(scene, change), change)
    if off <= CLOSER * float(_places(placed.scene, survey).deviations().median()):
        return Placed(scene)
    axes = placed.scene.views.rotation[placed.scene.views.registered][:, 2]
    if float(axes.mean(dim=0)[2]) > 0.0:
        raise SurveyError(
            "with the positions of the survey the cameras look at the sky: z must point up, x east and y north; check "
            "whether x and y are exchanged"
        )
    (recorder or SilentRecorder()).note(
        f"the reconstruction was brought into the frame of the survey: turned by {placed.turn_deg:.2f} degrees, scaled "
        f"by {float(change.scale):.5g} and shifted by {placed.shift(scene):.4g} {scene.length_unit}"
    )
    return placed


def upright(placed: Placed, survey: Survey) -> Placed | None:
    """The scene with z up, its interfaces as they are: where it stands if positions of the survey say so, or turned by
    the gravity of the survey; None where neither says it."""
    scene, places = placed.scene, _places(placed.scene, survey)
    down = mean_down(scene, survey)
    if placed.change is not None or places.similarity() is not None:
        return placed
    if down is None:
        return None
    change = Similarity(torch.ones_like(down[0]), levelling(down), torch.zeros_like(down))
    return Placed(transformed(scene, change), change)


def mean_down(scene: Scene, survey: Survey) -> Float[Tensor, "3"] | None:
    """The vertical that most images with gravity agree on, in the frame of the scene; None where there are none."""
    known = scene.views.registered[survey.down_image]
    if not bool(known.any()):
        return None
    rotation = scene.views.rotation[survey.down_image[known]]
    down = (rotation.mT @ survey.down_in_cam[known][..., None])[..., 0]
    return mean_vertical(down, survey.down_sigma[known])[0]


def _places(scene: Scene, survey: Survey) -> StatedPlaces:
    """Those that the scene has, its ground control points being where their rays meet."""
    everything = with_control(scene, survey)
    wanted = torch.arange(len(everything.points)) >= len(scene.points)
    every = StatedPlaces.of(with_meeting_points(everything, wanted), survey)
    return every[every.known]


def _require_near(scene: Scene, places: StatedPlaces, is_level: bool) -> None:
    """Refuse a scene that is elsewhere, and that nothing brings to where it should be."""
    center = scene.views.center[scene.views.registered]
    extent = float((center - center.mean(dim=0)).norm(dim=-1).max())
    far = float((places.found - places.stated).norm(dim=-1).median())
    if far <= extent:
        return
    wanted = f"{FEWEST_LEVEL} that are apart" if is_level else f"{FEWEST} that are not on a line, or gravity and two"
    raise SurveyError(
        f"the reconstruction is {far:.4g} {scene.length_unit} from the positions of the survey (median), but "
        f"{len(places)} of them do not say how it is turned and scaled: give {wanted}"
    )
