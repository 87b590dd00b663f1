"""Positions of cameras and of ground control, as stated, against where the adjusted scene has them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import align_similarity
from torchrefrac.refinement import refine_points
from torchrefrac.scene import Scene, Survey, Surveyed
from torchrefrac.sfm.control import CLICK
from torchrefrac.sfm.gravity import unlikely
from torchrefrac.sfm.rays import Tracks
from torchrefrac.sfm.rules import Rules
from torchrefrac.sfm.stated_places import StatedPlaces
from torchrefrac.sfm.triangulate import triangulate

FEWEST = 4
"""Stated positions that must agree where some are left out: fewer do not tell which is wrong."""
CANDIDATES = 4
"""Of the worst positions, those of which each is tried to be left out: it is not always the worst that is wrong."""
SCATTERED = 5.0
"""Times the median distance at which a position is far off, where images are less certain than what was stated."""


@dataclass(frozen=True, eq=False)
class Disagreement:
    """How far positions are from where they were stated to be: in length units, and in standard deviations of what was
    stated; 0 where nothing is known, infinite where not even the images of it fit there."""

    distance: Float[Tensor, " k"]
    deviations: Float[Tensor, " k"]

    @property
    def contradicted(self) -> Bool[Tensor, " k"]:
        """Those that are farther off than what was stated explains."""
        return self.deviations > unlikely(len(self.deviations), 3)


def of_centers(scene: Scene, survey: Survey) -> Disagreement:
    """Of the camera centres of a survey."""
    error = scene.views.center[survey.center_image] - survey.center
    registered = scene.views.registered[survey.center_image]
    return _disagreement(torch.where(registered[:, None], error, 0.0), survey.center_information)


def of_control(scene: Scene, survey: Survey) -> Disagreement:
    """Of the ground control points with known positions; those of the survey are the last points of the scene. Where
    the pixels of one do not fit there it has no place: it is then put where its rays meet."""
    ids = len(scene.points) - len(survey.control_names) + survey.known_control
    lost = ~scene.placed[ids] & (scene.sightings()[ids] >= 2)
    wanted = torch.zeros_like(scene.placed).index_fill(0, ids[lost], True)
    met = with_meeting_points(scene, wanted)
    known = met.placed[ids]
    error = torch.where(known[:, None], met.points[ids] - survey.known_position, 0.0)
    found = _disagreement(error, survey.known_information)
    return replace(found, deviations=torch.where(lost & known, torch.inf, found.deviations))


def with_meeting_points(scene: Scene, wanted: Bool[Tensor, " n"]) -> Scene:
    """The scene with the points `wanted` where all their rays meet, however badly; those that fewer than two registered
    views see have no place."""
    return triangulate(scene, replace(Rules(), max_error=torch.inf, min_angle_deg=0.0), wanted)[0]


def surveyed(scene: Scene, stated: Survey, used: Survey) -> Surveyed:
    """What became of a survey, of which `used` took part, in the scene, whose last points are its control points; its
    assessment, if it has one, is of all its points."""
    ties, control = len(scene.points) - len(stated.control_names), of_control(scene, stated)
    met = with_meeting_points(scene, torch.arange(len(scene.points)) >= ties)
    ids = ties + stated.known_control
    off = torch.where(met.placed[ids, None], met.points[ids] - stated.known_position, 0.0)
    where = scene.points[ties:], scene.placed[ties:], met.placed[ties:], _deviations(scene)[ties:]
    check = ties + stated.check_control
    check_off = torch.where(met.placed[check, None], met.points[check] - stated.check_position, 0.0)
    return Surveyed(stated, used, *where, off, control.distance, control.deviations, check_off)


def _deviations(scene: Scene) -> Float[Tensor, "n 3"]:
    """Of all points along the axes; infinite where nothing is known."""
    covariance = scene.assessment.point_covariance
    if covariance is None:
        return torch.full_like(scene.points, torch.inf)
    return covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()


def without_contradicted(scene: Scene, survey: Survey) -> Survey:
    """The survey without the positions that most others contradict; itself where there are none.

    scene: as images have it, with all ground control points; its frame does not count. Positions of cameras and control
    are aligned with those stated by a similarity. The one without which the others agree best is left out where it is
    too far off their alignment, and so on with these as long as most stay. What clicks leave open of where a control
    point is counts as well.
    """
    places = StatedPlaces.of(scene, survey)
    places = places.blurred(torch.cat((torch.zeros_like(survey.center_information), _left_by_clicks(scene, survey))))
    found, stated, known = places.found, places.stated, places.known
    accepted, least = known.clone(), max(FEWEST, (int(known.sum()) + 2) // 2)

    def off(accepted: Bool[Tensor, " k"]) -> Float[Tensor, " k"]:
        """Deviations from the alignment of those that are accepted."""
        return places.deviations(align_similarity(found[accepted], stated[accepted]))

    while int(accepted.sum()) > least:
        worst = torch.where(accepted, off(accepted), 0.0).topk(CANDIDATES).indices.tolist()
        without = [accepted & (torch.arange(len(accepted)) != i) for i in worst]
        candidate, others, fewer = min(
            ((i, off(fewer), fewer) for i, fewer in zip(worst, without, strict=True)),
            key=lambda tried: float(tried[1][tried[2]].square().sum()),
        )
        usual = SCATTERED * float(others[fewer].median())
        if float(others[candidate]) <= max(unlikely(int(fewer.sum()), 3), usual):
            break
        accepted = fewer
    out = known & ~accepted
    return survey.without(out[: places.cameras], out[places.cameras :]) if bool(out.any()) else survey


def _left_by_clicks(scene: Scene, survey: Survey) -> Float[Tensor, "p 3 3"]:
    """Covariances of where control points with known positions are by their pixels alone; zero where these do not say
    it."""
    ids = len(scene.points) - len(survey.control_names) + survey.known_control
    wanted = torch.zeros_like(scene.placed).index_fill(0, ids, True)
    rows = scene.views.registered[scene.observations.view] & wanted[scene.observations.point]
    covariance = scene.points.new_zeros(len(scene.points), 3, 3)
    if bool(rows.any()):
        tracks = Tracks.of(scene, rows.nonzero()[:, 0])
        seen = tracks.cameras, tracks.pixels, tracks.slot
        covariance[tracks.ids] = refine_points(*seen, scene.points[tracks.ids], CLICK).covariance
    return covariance[ids]


def _disagreement(error: Float[Tensor, "k 3"], information: Float[Tensor, "k 3 3"]) -> Disagreement:
    square = (error[:, None] @ information @ error[..., None])[:, 0, 0]
    return Disagreement(error.norm(dim=-1), square.clamp(min=0.0).sqrt())
