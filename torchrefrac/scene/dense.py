"""What a dense reconstruction consists of: oriented points, and what each image sees of the surface."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class DenseCloud:
    """n oriented points on the surfaces of a scene, in its world frame (z up, water surface at z = 0).

    points (n, 3) float64 in length_unit; normals (n, 3) float64, unit, towards the cameras; colors (n, 3) uint8;
    sigma (n) float64: standard deviation of a point along its viewing ray, in length_unit; score (n) float64: mean
    zero-normalised cross-correlation (at most 1) of the reference image with the others; views (n) int64: by how many
    images a point is seen, the reference included; reference (n) int64: index of the reference image.
    """

    points: Tensor
    normals: Tensor
    colors: Tensor
    sigma: Tensor
    score: Tensor
    views: Tensor
    reference: Tensor
    length_unit: str

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: Tensor) -> "DenseCloud":
        """Some of the points, by a mask (n) or indices."""
        return DenseCloud(
            self.points[rows],
            self.normals[rows],
            self.colors[rows],
            self.sigma[rows],
            self.score[rows],
            self.views[rows],
            self.reference[rows],
            self.length_unit,
        )

    @classmethod
    def empty(cls, length_unit: str) -> "DenseCloud":
        vectors, numbers = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        counts = torch.zeros(0, dtype=torch.long)
        return cls(vectors, vectors, vectors.to(torch.uint8), numbers, numbers, counts, counts, length_unit)


@dataclass(frozen=True)
class DepthMap:
    """What one image sees of the surface, on a grid of h x w cells of `step` x `step` pixels.

    Where valid (h, w): points (h, w, 3) in the world frame, at the cell's centre, of row i and column j the pixel
    (step (j + 1/2), step (i + 1/2)); depth (h, w): their z in the camera's frame, the ordinary depth (not the apparent
    one); sigma (h, w) along the viewing ray. In length_unit; zero where not valid.
    """

    name: str
    step: int
    points: Tensor
    depth: Tensor
    sigma: Tensor
    valid: Tensor
    length_unit: str
