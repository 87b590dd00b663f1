"""Least-squares alignment of corresponding points: full similarity, and the one that keeps the water plane."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry.gravity import heading_rotation


@dataclass(frozen=True)
class Similarity:
    """`b_from_a`: x_in_b = scale * rotation @ x_in_a + translation."""

    scale: Float[Tensor, ""]
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, " 3"]

    def apply(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The points in b."""
        return self.scale * points @ self.rotation.mT + self.translation

    def apply_to_rotation(self, cam_from_a: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
        """`cam_from_b` rotations of cameras given by `cam_from_a`."""
        return cam_from_a @ self.rotation.mT


def align_similarity(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Similarity:
    """The 7-dof similarity that maps `source` onto `target` (Umeyama, PAMI 1991)."""
    source_mean, target_mean = source.mean(dim=0), target.mean(dim=0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = torch.linalg.svd(b.mT @ a)
    sign = singular.new_tensor((1.0, 1.0, 1.0))
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    rotation = u @ torch.diag(sign) @ vt
    spread = a.square().sum()
    scale = (singular * sign).sum() / torch.where(spread > 0, spread, torch.ones_like(spread))
    return Similarity(scale, rotation, target_mean - scale * (rotation @ source_mean))


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
