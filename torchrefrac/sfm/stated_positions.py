"""Positions of cameras that a capture states, as of satellites: they give the finished scene its place, its heading and
its scale, and then take part in the adjustment with their errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from torchrefrac.bundle import CenterPrior
from torchrefrac.geometry import Similarity, heading_rotation
from torchrefrac.numerics import thin
from torchrefrac.scene import Capture, Part, Scene, Survey
from torchrefrac.sfm.frame import mean_level, transformed
from torchrefrac.sfm.positions import without_contradicted

FEWEST = 3
SPREAD = 3.0
"""Horizontal errors of positions that these must be apart, for them to say which way is north, and how large things
are."""
TRIED = 2000
OUTLYING = 5.0
"""Median deviations beyond which a position takes no part in the alignment."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Of the views of a scene, in the local frame of the capture, but `level` (the height of the water there; 0 where
    there is none) lower; information is the inverse covariance; known: of which views they count."""

    position: Float[Tensor, "m 3"]
    information: Float[Tensor, "m 3 3"]
    known: Bool[Tensor, " m"]
    level: float = 0.0

    @classmethod
    def of(cls, capture: Capture) -> "Positions":
        """All that are stated."""
        known = capture.position_sigma.isfinite().all(dim=-1)
        variance = torch.where(known[:, None], capture.position_sigma, 1.0).square()
        return cls(capture.position, torch.diag_embed(1.0 / variance), known)

    def lowered(self, by: float) -> "Positions":
        """The same with the water so much higher."""
        down = self.position.new_tensor((0.0, 0.0, by))
        return replace(self, position=self.position - down, level=self.level + by)

    def terms(self, part: Part) -> Sequence[CenterPrior]:
        """Those of the views of a part of the scene, as a prior."""
        rows = self.known[part.view].nonzero()[:, 0]
        view = part.view[rows]
        return (CenterPrior(rows, self.position[view], self.information[view]),) if len(rows) else ()

    def survey(self, names: Sequence[str]) -> Survey:
        """The same of the views of these names as measurements of a survey."""
        rows = self.known.nonzero()[:, 0]
        return replace(
            Survey.empty(names),
            center=self.position[rows],
            center_information=self.information[rows],
            center_image=rows,
        )

    def of_most(self, scene: Scene) -> "Positions":
        """Without those that most others contradict."""
        used = without_contradicted(scene, self.survey(scene.views.names)).center_image
        return replace(self, known=torch.zeros_like(self.known).index_fill(0, used, True))


def placed_by_positions(scene: Scene, capture: Capture) -> tuple[Scene, Positions] | None:
    """The scene in the frame of the positions, and these; in it the water stays the plane z = 0.

    None where too few views have one, or they lie too close together for their errors. Through water the vertical of
    the scene counts, and without refraction that of the gravity measured: heading, scale and place follow from a
    horizontal similarity, whichever few positions are wrong, and the height from the mean.
    """
    positions = Positions.of(capture)
    rows = (scene.views.registered & positions.known).nonzero()[:, 0]
    if len(rows) < FEWEST:
        return None
    refractive = scene.index_ratio > 1.0
    level = torch.eye(3, dtype=torch.float64) if refractive else mean_level(scene, capture)
    center, stated = scene.views.center[rows] @ level.T, positions.position[rows]
    sigma = capture.position_sigma[rows, :2].square().mean(dim=-1).sqrt()
    spread = (stated[:, :2] - stated[:, :2].mean(dim=0)).square().sum(dim=-1).mean().sqrt()
    if float(spread) < SPREAD * float(sigma.median()):
        return None
    ours, theirs = (torch.complex(at[:, 0], at[:, 1]) for at in (center, stated))
    factor, shift, accepted = _horizontal(ours, theirs, sigma)
    scale = factor.abs()
    turn = heading_rotation(factor.angle())
    height = (stated[accepted, 2] - scale * center[accepted, 2]).mean()
    lift = height.new_zeros(()) if refractive else height
    change = Similarity(scale, turn @ level, torch.stack((shift.real, shift.imag, lift)))
    return transformed(scene, change), positions.lowered(float(height) if refractive else 0.0)


def _horizontal(
    ours: Complex[Tensor, " k"], theirs: Complex[Tensor, " k"], sigma: Float[Tensor, " k"]
) -> tuple[Complex[Tensor, ""], Complex[Tensor, ""], Bool[Tensor, " k"]]:
    """theirs = factor ours + shift: by those that agree with the similarity of two which has the least median error."""
    first, second = torch.triu_indices(len(ours), len(ours), 1)
    some = thin(torch.arange(len(first)), TRIED)
    first, second = first[some], second[some]
    factor = (theirs[second] - theirs[first]) / (ours[second] - ours[first])
    error = (theirs - factor[:, None] * ours - (theirs[first] - factor * ours[first])[:, None]).abs() / sigma
    median = error.median(dim=1).values
    best = median.nan_to_num(torch.inf).argmin()
    accepted = error[best] <= OUTLYING * torch.maximum(median[best], torch.ones_like(median[best]))
    weight = torch.where(accepted, 1.0 / sigma.square(), 0.0)
    return *_fit(ours, theirs, weight), accepted


def _fit(
    ours: Complex[Tensor, " k"], theirs: Complex[Tensor, " k"], weight: Float[Tensor, " k"]
) -> tuple[Complex[Tensor, ""], Complex[Tensor, ""]]:
    """The similarity of least squares."""
    middle, goal = ((weight * at).sum() / weight.sum() for at in (ours, theirs))
    a, b = ours - middle, theirs - goal
    factor = (weight * a.conj() * b).sum() / (weight * a.abs().square()).sum()
    return factor, goal - factor * middle
