"""Levels of the water that a survey states, by gauges and points of the shore, beside where a scene has them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.scene import Capture, Scene, Survey, SurveyError
from torchrefrac.sfm.control import surface_of_levels

CONTRADICTED = 3.0
"""Standard deviations from which on a level is not what the others are."""


@dataclass(frozen=True, eq=False)
class StatedLevels:
    """By their sources: the height of the water, in the frame of the survey, its standard deviation, and the interface
    of the scene that it is about."""

    height: Float[Tensor, " s"]
    sigma: Float[Tensor, " s"]
    surface: Int[Tensor, " s"]

    @classmethod
    def of(cls, survey: Survey, scene: Scene) -> "StatedLevels":
        """Of several places of one source the weighted mean."""
        weight, none = survey.level_sigma.square().reciprocal(), torch.zeros(len(survey.level_sources)).double()
        information = none.index_add(0, survey.level, weight)
        height = none.index_add(0, survey.level, weight * survey.level_position[:, 2]) / information
        return cls(height, information.rsqrt(), surface_of_levels(survey, scene))

    def agree_with(self, level: Float[Tensor, " e"], sigma: Float[Tensor, " e"]) -> Bool[Tensor, " s"]:
        """Which of them are where a scene without them has its interfaces, with standard deviations sigma."""
        off = (self.height - level[self.surface]).abs()
        return off <= CONTRADICTED * torch.hypot(self.sigma, sigma[self.surface])

    def others(
        self, level: Float[Tensor, " e"], sigma: Float[Tensor, " e"], used: Bool[Tensor, " s"]
    ) -> "StatedLevels":
        """What everything else than each of them says, by inverse variances, where a scene adjusted with those `used`
        has its interfaces; infinitely uncertain where that is nothing."""
        every, own = sigma.square().reciprocal()[self.surface], torch.where(used, self.sigma.square().reciprocal(), 0.0)
        rest = (every - own).clamp(min=0.0)
        height = (every * level[self.surface] - own * self.height) / rest.clamp(min=torch.finfo(rest.dtype).tiny)
        return StatedLevels(torch.where(rest > 0.0, height, self.height), rest.rsqrt(), self.surface)


def check_levels(survey: Survey, capture: Capture) -> None:
    """Raise SurveyError for levels of epochs that the capture has not, and of water above the cameras."""
    epochs = capture.epochs if len(capture.epochs) > 1 else ("",)
    for source, epoch in zip(survey.level_sources, survey.level_epochs, strict=True):
        if epoch not in epochs and (epoch or len(epochs) > 1):
            wanted = f"must be one of those of the photographs: {', '.join(capture.epochs) or 'they have none'}"
            raise SurveyError(f"{source} of the survey is of the epoch {epoch!r}, but it {wanted}")
    known = capture.position_sigma.isfinite().all(dim=-1)
    if not len(survey.level) or not bool(known.any()):
        return
    cameras = capture.position[known, 2] + CONTRADICTED * capture.position_sigma[known, 2]
    highest, above = float(cameras.max()), survey.level_position[:, 2] - CONTRADICTED * survey.level_sigma
    if bool((above > highest).any()):
        worst = int(above.argmax())
        raise SurveyError(
            f"{survey.level_sources[int(survey.level[worst])]} of the survey puts the water at "
            f"{float(survey.level_position[worst, 2]):.6g}, above all cameras (the highest at "
            f"{float(capture.position[known, 2].max()):.6g}); check what the two heights are counted from"
        )
