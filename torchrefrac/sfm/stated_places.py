"""Where a survey states that cameras and ground control points are, beside where a scene has them; and the similarity
between the two."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import Similarity, are_on_a_line, robust_level_similarity, robust_similarity
from torchrefrac.scene import Scene, Survey

SPREAD = 3.0
"""Errors of places that these must be apart, for them to say how a scene is turned, and how large it is."""
FEWEST_LEVEL, FEWEST = 2, 3
"""Places that a similarity needs where the vertical is known, and where it is not."""
CLEAR = 10.0
"""Times that deviations must be smaller with x and y exchanged."""
UPRIGHT = 0.7
"""Cosine of the angle by which a similarity may turn a vertical that is known."""
OTHER_UNIT = 1.5
"""Ratio of two scales from which on lengths are in different units."""


@dataclass(frozen=True)
class Mistake:
    """One that people make in what they state: x and y that are exchanged, or ground control in another frame or unit
    than the cameras. of_cameras: whether it is about these."""

    sentence: str
    of_cameras: bool


@dataclass(frozen=True, eq=False)
class StatedPlaces:
    """Of the camera centres of a survey, then its ground control points with known positions: found, as a scene has
    them; stated, with the inverse covariance `information`; known: which of them the scene has. cameras: how many of
    them are centres."""

    found: Float[Tensor, "k 3"]
    stated: Float[Tensor, "k 3"]
    information: Float[Tensor, "k 3 3"]
    known: Bool[Tensor, " k"]
    cameras: int

    @classmethod
    def of(cls, scene: Scene, survey: Survey) -> "StatedPlaces":
        """scene: with the ground control points of the survey as its last points."""
        ids = len(scene.points) - len(survey.control_names) + survey.known_control
        return cls(
            torch.cat((scene.views.center[survey.center_image], scene.points[ids])),
            torch.cat((survey.center, survey.known_position)),
            torch.cat((survey.center_information, survey.known_information)),
            torch.cat((scene.views.registered[survey.center_image], scene.placed[ids])),
            len(survey.center),
        )

    def __len__(self) -> int:
        return len(self.stated)

    def __getitem__(self, rows: Bool[Tensor, " k"]) -> "StatedPlaces":
        """Those in a mask."""
        of = self.found[rows], self.stated[rows], self.information[rows], self.known[rows]
        return StatedPlaces(*of, int(rows[: self.cameras].sum()))

    @property
    def of_control(self) -> Bool[Tensor, " k"]:
        """Which are of ground control points."""
        return torch.arange(len(self)) >= self.cameras

    def swapped(self, rows: Bool[Tensor, " k"]) -> "StatedPlaces":
        """With x and y of some exchanged."""
        order = torch.tensor([1, 0, 2])
        stated = torch.where(rows[:, None], self.stated[:, order], self.stated)
        information = torch.where(rows[:, None, None], self.information[:, order][:, :, order], self.information)
        return StatedPlaces(self.found, stated, information, self.known, self.cameras)

    @property
    def covariance(self) -> Float[Tensor, "k 3 3"]:
        """Of what is stated."""
        return torch.linalg.inv(self.information)

    def blurred(self, covariance: Float[Tensor, "k 3 3"]) -> "StatedPlaces":
        """With what is not known of the places found, besides, as if it was not known of those stated."""
        return replace(self, information=torch.linalg.inv(self.covariance + covariance))

    def deviations(self, change: Similarity | None = None) -> Float[Tensor, " k"]:
        """How far what was found, in the frame to which a similarity takes it, is from what was stated, in standard
        deviations of that."""
        error = (self.found if change is None else change.apply(self.found)) - self.stated
        return (error[:, None] @ self.information @ error[..., None])[:, 0, 0].clamp(min=0.0).sqrt()

    def level_similarity(self, level: Float[Tensor, "3 3"]) -> tuple[Similarity, Bool[Tensor, " k"]] | None:
        """From the scene to what is stated, where the rotation `level` puts the scene's vertical upright; and which
        places agree with it. None where there are too few, or they lie too close together for their errors."""
        horizontal = self.covariance[:, :2, :2].diagonal(dim1=-2, dim2=-1).mean(dim=-1).sqrt()
        if len(self) < FEWEST_LEVEL or _spread(self.stated[:, :2]) < SPREAD * float(horizontal.median()):
            return None
        change, agreeing = robust_level_similarity(self.found @ level.mT, self.stated, horizontal)
        return Similarity(change.scale, change.rotation @ level, change.translation), agreeing

    def similarity(self) -> tuple[Similarity, Bool[Tensor, " k"]] | None:
        """The same where nothing is known of the vertical. None also where they lie on a line."""
        sigma = self.covariance.diagonal(dim1=-2, dim2=-1).mean(dim=-1).sqrt()
        if len(self) < FEWEST or are_on_a_line(self.stated, SPREAD * sigma.median()):
            return None
        return robust_similarity(self.found, self.stated, sigma)

    def best(self, level: Float[Tensor, "3 3"] | None, enough: float) -> Similarity | None:
        """The first similarity, with the vertical or without, that leaves a median of `enough` deviations at most, or
        the one that leaves the least; None where there is none."""
        tried = [None if level is None else self.level_similarity(level), self.similarity()]
        found = [(float(self.deviations(one[0]).median()), one[0]) for one in tried if one is not None]
        if level is not None:
            found = [(far, change) for far, change in found if float((change.rotation @ level.mT)[2, 2]) > UPRIGHT]
        good = next((change for far, change in found if far <= enough), None)
        return good or min(found, key=lambda one: one[0], default=(0.0, None))[1]

    def mistake(self, level: Float[Tensor, "3 3"] | None) -> Mistake | None:
        """What people do that explains why what is stated does not fit; None where nothing does."""
        if not len(self):
            return None
        usual, control = self._left(level).clamp(min=1.0), self.of_control
        before = torch.minimum(usual, self.deviations())
        kinds = {"position of marks": control, "center of images": ~control, "all positions": control | ~control}
        for what, rows in kinds.items():
            left = self.swapped(rows)._left(level).clamp(min=1.0)
            if (
                bool(rows.any())
                and left[rows].median() < before[rows].median() / CLEAR
                and left.log1p().mean() < usual.log1p().mean()
            ):
                told = "fits far better with x and y exchanged: x is east and y is north, exchange them"
                return Mistake(f"{what} in the survey {told}", bool((rows & ~control).any()))
        first, second = (self[rows].best(level, 0.0) for rows in (control, ~control))
        if first is None or second is None:
            return None
        apart = torch.where(control, self.deviations(first), self.deviations(second))
        if float(apart.log1p().mean()) > float(before.log1p().mean()) - 1.0:
            return None
        told = self._of_two_frames(first, second)
        return Mistake(f"{told}: give both in one", False) if told else None

    def _of_two_frames(self, first: Similarity, second: Similarity) -> str:
        """What differs between the frames of ground control and of cameras, to which the two similarities lead; empty
        where it is nothing that people mistake."""
        control, ratio = self.of_control, float(second.scale / first.scale)
        between = first.apply(self.found) - second.apply(self.found)
        far, aside = float(between.norm(dim=-1).median()), float(between[:, :2].norm(dim=-1).median())
        above = float(between[:, 2].median().abs())
        places = "position of marks and center of images in the survey are in"
        if max(ratio, 1.0 / ratio) > OTHER_UNIT:
            return f"{places} units that differ by a factor of {max(ratio, 1.0 / ratio):.4g}"
        if above > CLEAR * aside:
            return f"heights of marks and of images count from levels that are {above:.4g} apart, as of two datums"
        if far > _spread(self.stated[control]) + _spread(self.stated[~control]):
            return f"{places} frames that are {far:.4g} apart"
        return ""

    def _left(self, level: Float[Tensor, "3 3"] | None) -> Float[Tensor, " k"]:
        """Deviations after the best similarity; infinite where there is none."""
        change = self.best(level, 0.0)
        return torch.full_like(self.stated[:, 0], torch.inf) if change is None else self.deviations(change)


def _spread(points: Float[Tensor, "n d"]) -> float:
    """Root mean square distance from the mean."""
    return float((points - points.mean(dim=0)).square().sum(dim=-1).mean().sqrt())
