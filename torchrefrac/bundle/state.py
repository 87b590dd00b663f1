"""What a bundle adjustment starts from and ends with."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface


@dataclass(frozen=True)
class BundleState:
    """Cameras, points, lenses and water.

    rotation (m, 3, 3) cam_from_world, center (m, 3), points (n, 3). lens: intrinsics, either one for all images or a
    batch (G), of which parts may have no batch dimension. index_ratio: scalar. normal (E, 3), offset (E): the water
    planes normal . x = offset, unit normals towards the cameras; by default the one plane z = 0. Raises ValueError for
    a normal without an offset, or the reverse.
    """

    rotation: Tensor
    center: Tensor
    points: Tensor
    lens: Intrinsics
    index_ratio: Tensor
    normal: Tensor | None = None
    offset: Tensor | None = None

    def __post_init__(self) -> None:
        if (self.normal is None) != (self.offset is None):
            given, lacking = ("offset", "normal") if self.normal is None else ("normal", "offset")
            raise ValueError(f"{given} is given without {lacking}, but a water plane needs both")
        if self.lens.shape:
            object.__setattr__(self, "lens", _in_full(self.lens))
        if self.normal is None:
            level = self.center.new_tensor(((0.0, 0.0, 1.0),))
            object.__setattr__(self, "normal", level)
            object.__setattr__(self, "offset", level[:, 0])

    @property
    def planes(self) -> tuple[Tensor, Tensor]:
        """normal and offset."""
        assert self.normal is not None
        assert self.offset is not None
        return self.normal, self.offset

    def cameras(self, links: "Links", image: Tensor) -> RefractiveCamera:
        """The cameras of images (*B), as a batch (*B)."""
        normal, offset = self.planes
        plane = Plane(normal[links.plane[image]], offset[links.plane[image]], check=False)
        lens = self.lens if not self.lens.shape else self.lens.indexed(links.lens[image], self.lens.shape)
        interface = FlatInterface(self.index_ratio, plane=plane, check=False)
        return RefractiveCamera(lens, self.rotation[image], self.center[image], interface, check=False)

    def detached(self) -> "BundleState":
        """The same without a graph."""
        lens = replace(
            self.lens,
            focal=self.lens.focal.detach(),
            principal_point=self.lens.principal_point.detach(),
            distortion=self.lens.distortion.detach(),
        )
        normal, offset = self.planes
        return BundleState(
            self.rotation.detach(),
            self.center.detach(),
            self.points.detach(),
            lens,
            self.index_ratio.detach(),
            normal.detach(),
            offset.detach(),
        )


@dataclass(frozen=True)
class Links:
    """Which lens (m) and which water plane (m) each image has."""

    lens: Tensor
    plane: Tensor

    @classmethod
    def single(cls, state: BundleState) -> "Links":
        """One lens and one plane for all images."""
        none = torch.zeros(len(state.center), dtype=torch.long, device=state.center.device)
        return cls(none, none)


@dataclass(frozen=True)
class Observations:
    """`pixels` (N, 2) of point `point` (N) in image `camera` (N), in any order, a pair at most once.

    weight (N): of each squared residual, 1 by default.
    """

    camera: Tensor
    point: Tensor
    pixels: Tensor
    weight: Tensor | None = None

    def __len__(self) -> int:
        return len(self.camera)

    def __getitem__(self, rows: Tensor | slice) -> "Observations":
        weight = None if self.weight is None else self.weight[rows]
        return Observations(self.camera[rows], self.point[rows], self.pixels[rows], weight)

    @property
    def weights(self) -> Tensor:
        """weight, or ones."""
        return torch.ones_like(self.pixels[:, 0]) if self.weight is None else self.weight

    def detached(self) -> "Observations":
        """The same without a graph."""
        weight = None if self.weight is None else self.weight.detach()
        return replace(self, pixels=self.pixels.detach(), weight=weight)


def _in_full(lens: Intrinsics) -> Intrinsics:
    """With a batch dimension on each part, and no copies."""
    shape = lens.shape
    focal, middle = lens.focal.expand(*shape, 2), lens.principal_point.expand(*shape, 2)
    distortion = lens.distortion.expand(*shape, 5)
    return replace(lens, focal=focal, principal_point=middle, distortion=distortion, check=False)
