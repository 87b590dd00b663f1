"""Levels of the water that a survey states, by gauges and points of the shore, beside where a scene has them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.scene import Capture, Scene, Survey, SurveyError

CONTRADICTED = 3.0
"""Standard deviations from which on a level is not what the others are."""
SLOPES = 0.01, 0.002
"""Standard deviations of the slope of a river, before its levels are known, along the line on which these are stated,
and across, as where it bends."""


@dataclass(frozen=True, eq=False)
class StatedLevels:
    """By their sources: the height of the water, in the frame of the survey, its standard deviation, the interface of
    the scene that it is about, the place in x and y, and whether that is known, or it is taken at the middle of the
    cameras."""

    height: Float[Tensor, " s"]
    sigma: Float[Tensor, " s"]
    surface: Int[Tensor, " s"]
    place: Float[Tensor, "s 2"]
    has_place: Bool[Tensor, " s"]

    @classmethod
    def of(cls, survey: Survey, scene: Scene) -> "StatedLevels":
        """Of several places of one source the weighted mean."""
        weight, none = survey.level_sigma.square().reciprocal(), torch.zeros(len(survey.level_sources)).double()
        information = none.index_add(0, survey.level, weight)
        places = places_of_levels(survey, scene)
        total = none[:, None].expand(-1, 3).index_add(0, survey.level, weight[:, None] * places)
        mean = total / information[:, None]
        has_place = torch.zeros_like(none, dtype=torch.bool).index_fill(0, survey.level[survey.level_has_place], True)
        return cls(mean[:, 2], information.rsqrt(), surface_of_levels(survey, scene), mean[:, :2], has_place)

    def show_slope(self, scene: Scene, used: Bool[Tensor, " s"] | None = None) -> bool:
        """Whether those `used`, by default all, have places so far apart that they know the slope of the one surface of
        a scene better than it is known of rivers."""
        rows = self.has_place if used is None else self.has_place & used
        if len(scene.interfaces) > 1 or int(rows.sum()) < 2:
            return False
        sigma, apart = self.sigma[rows], torch.cdist(self.place[rows], self.place[rows])
        return bool((torch.hypot(sigma[:, None], sigma) < SLOPES[0] * apart).any())

    @property
    def along(self) -> Float[Tensor, "2"]:
        """The unit vector along which the places are apart."""
        place = self.place[self.has_place]
        place = place - place.mean(dim=0)
        return torch.linalg.eigh(place.mT @ place).eigenvectors[:, 1]

    def at_interfaces(self, scene: Scene) -> Float[Tensor, " s"]:
        """How high the interfaces of a scene stand at the places."""
        normal, offset = scene.interfaces.normal[self.surface], scene.interfaces.offset[self.surface]
        return (offset - (normal[:, :2] * self.place).sum(dim=-1)) / normal[:, 2]

    def agree_with(self, level: Float[Tensor, " #s"], sigma: Float[Tensor, " #s"]) -> Bool[Tensor, " s"]:
        """Which of them are where a scene without them has its interfaces, with standard deviations sigma."""
        return (self.height - level).abs() <= CONTRADICTED * torch.hypot(self.sigma, sigma)

    def agree_on_slope(self, scene: Scene, sigma: Float[Tensor, " 1"]) -> Bool[Tensor, " s"]:
        """Which of them lie in one plane with each other and with the one interface of a scene without them, which has
        its height at the middle of the cameras with a standard deviation sigma, and a slope by SLOPES.

        The one that is farthest from what all others say is left out while it is too far (Baarda's data snooping).
        """
        east, north = self.along
        axes = torch.stack((self.along, torch.stack((-north, east))))
        from_middle = (self.place - scene.middle[:2]) @ axes.mT * axes.new_tensor(SLOPES)
        rows = torch.cat((sigma.expand(len(self.place), 1), from_middle), dim=1) / self.sigma[:, None]
        above = (self.height - self.at_interfaces(scene)) / self.sigma
        used = torch.ones_like(self.has_place)
        while bool(used.any()):
            known = torch.where(used[:, None], rows, 0.0)
            inverse = torch.linalg.inv(known.mT @ known + torch.eye(3).to(rows))
            off = above - rows @ (inverse @ (known.mT @ above))
            free = 1.0 - (rows @ inverse * rows).sum(dim=-1)
            deviation = torch.where(used, off.abs() / free.clamp(min=0.0).sqrt(), 0.0)
            worst = int(deviation.argmax())
            if not float(deviation[worst]) > CONTRADICTED:
                break
            used[worst] = False
        return used

    def others(
        self, level: Float[Tensor, " #s"], sigma: Float[Tensor, " #s"], used: Bool[Tensor, " s"]
    ) -> "StatedLevels":
        """What everything else than each of them says, by inverse variances, where a scene adjusted with those `used`
        has its interfaces; infinitely uncertain where that is nothing."""
        every, own = sigma.square().reciprocal(), torch.where(used, self.sigma.square().reciprocal(), 0.0)
        rest = (every - own).clamp(min=0.0)
        height = (every * level - own * self.height) / rest.clamp(min=torch.finfo(rest.dtype).tiny)
        return replace(self, height=torch.where(rest > 0.0, height, self.height), sigma=rest.rsqrt())


def surface_of_levels(survey: Survey, scene: Scene) -> Int[Tensor, " s"]:
    """Which interface of a scene each source of levels is about: that of its epoch, or the only one."""
    epochs = scene.capture.epochs if scene.capture is not None and len(scene.interfaces) > 1 else ()
    rows = [epochs.index(name) if name in epochs else 0 for name in survey.level_epochs]
    return torch.tensor(rows, dtype=torch.long)


def places_of_levels(survey: Survey, scene: Scene) -> Float[Tensor, "l 3"]:
    """Where the water is stated to be: levels without a place are of the middle of the cameras."""
    position, middle = survey.level_position, scene.middle[:2]
    height = ((position * survey.up).sum(dim=-1) - (middle * survey.up[:2]).sum()) / survey.up[2]
    anywhere = torch.cat((middle.expand(len(height), 2), height[:, None]), dim=1)
    return torch.where(survey.level_has_place[:, None], position, anywhere)


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
