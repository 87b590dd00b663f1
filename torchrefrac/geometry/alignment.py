"""Least-squares alignment of corresponding points: full similarity, and the one that keeps the water plane."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.geometry.gravity import heading_rotation


@dataclass(frozen=True)
class Similarity:
    """`b_from_a`: x_in_b = scale * rotation @ x_in_a + translation."""

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Map points (*B, 3)."""
        return self.scale * points @ self.rotation.mT + self.translation

    def apply_to_rotation(self, cam_from_a: Tensor) -> Tensor:
        """`cam_from_b` rotations (*B, 3, 3) of cameras given by `cam_from_a`."""
        return cam_from_a @ self.rotation.mT


def align_similarity(source: Tensor, target: Tensor) -> Similarity:
    """The 7-dof similarity that maps `source` (N, 3) onto `target` (N, 3) (Umeyama, PAMI 1991)."""
    source_mean, target_mean = source.mean(dim=0), target.mean(dim=0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = torch.linalg.svd(b.mT @ a)
    sign = singular.new_tensor((1.0, 1.0, 1.0))
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    rotation = u @ torch.diag(sign) @ vt
    spread = a.square().sum()
    scale = (singular * sign).sum() / torch.where(spread > 0, spread, torch.ones_like(spread))
    return Similarity(scale, rotation, target_mean - scale * (rotation @ source_mean))


def align_above_plane(source: Tensor, target: Tensor) -> Similarity:
    """The 4-dof alignment (x, y, heading, scale) of `source` (N, 3) onto `target` (N, 3).

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
