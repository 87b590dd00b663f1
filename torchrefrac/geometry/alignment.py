"""Least-squares alignment of corresponding points: full similarity, and the one that keeps the water plane."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry.gravity import heading_rotation


@dataclass(frozen=True)
class Similarity:
    """`b_from_a`: x_in_b = scale * rotation @ x_in_a + translation. They compose as motions do."""

    scale: Float[Tensor, ""]
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, " 3"]

    def __matmul__(self, other: "Similarity") -> "Similarity":
        """This one after the other."""
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))

    @property
    def inverse(self) -> "Similarity":
        """`a_from_b`."""
        turned = self.rotation.mT @ self.translation
        return Similarity(1.0 / self.scale, self.rotation.mT, -turned / self.scale)

    def apply(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The points in b."""
        return self.scale * points @ self.rotation.mT + self.translation

    def apply_to_rotation(self, cam_from_a: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
        """`cam_from_b` rotations of cameras given by `cam_from_a`."""
        return cam_from_a @ self.rotation.mT


def align_similarity(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], weight: Float[Tensor, " n"] | None = None
) -> Similarity:
    """The 7-dof similarity that maps `source` onto `target` (Umeyama, PAMI 1991). weight: of each squared distance, by
    default 1."""
    return Similarity(*similarity_parts(source, target, torch.ones_like(source[:, 0]) if weight is None else weight))


def similarity_parts(
    source: Float[Tensor, "*batch n 3"], target: Float[Tensor, "*batch n 3"], weight: Float[Tensor, "*#batch n"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """Scales, rotations and translations of the same, of a batch (*B)."""
    total, weight = weight.sum(dim=-1, keepdim=True), weight[..., None]
    source_mean, target_mean = ((weight * points).sum(dim=-2) / total for points in (source, target))
    a, b = source - source_mean[..., None, :], target - target_mean[..., None, :]
    u, singular, vt = torch.linalg.svd((weight * b).mT @ a)
    last = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    sign = torch.stack((torch.ones_like(last), torch.ones_like(last), last), dim=-1)
    rotation = (u * sign[..., None, :]) @ vt
    spread = (weight * a.square()).sum(dim=(-2, -1))
    scale = (singular * sign).sum(dim=-1) / torch.where(spread > 0, spread, torch.ones_like(spread))
    return scale, rotation, target_mean - scale[..., None] * (rotation @ source_mean[..., None])[..., 0]


def align_above_plane(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Similarity:
    """The 4-dof alignment (x, y, heading, scale) of `source` onto `target`.

    It leaves the plane z = 0 and the vertical where they are: exactly the freedom that a reconstruction
    through a flat water surface has. The scale acts about the plane, so heights take part in it.
    """
    source_mean, target_mean = source[:, :2].mean(dim=0), target[:, :2].mean(dim=0)
    a, b = source[:, :2] - source_mean, target[:, :2] - target_mean
    sine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    cosine = (a * b).sum()
    rotation = heading_rotation(torch.atan2(sine, cosine))
    spread = a.square().sum() + source[:, 2].square().sum()
    scale = (torch.hypot(sine, cosine) + (source[:, 2] * target[:, 2]).sum()) / spread
    shift = target_mean - scale * (rotation[:2, :2] @ source_mean)
    return Similarity(scale, rotation, torch.cat((shift, shift.new_zeros(1))))
