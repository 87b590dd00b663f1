"""The tables of a scene: cameras, views and what was seen in them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid


@dataclass(frozen=True, eq=False)
class Cameras:
    """A table of intrinsics (see `Intrinsics`), and the size of the images of each in pixels, (width, height)."""

    sizes: tuple[tuple[int, int], ...]
    focal: Float[Tensor, "g 2"]
    principal_point: Float[Tensor, "g 2"]
    distortion: Float[Tensor, "g 5"]

    @classmethod
    def of(cls, every: Iterable[Intrinsics]) -> "Cameras":
        """From single intrinsics. Raises ValueError where some are batched."""
        every = tuple(every)
        for i, one in enumerate(every):
            if one.shape != ():
                raise ValueError(f"intrinsics[{i}] has batch shape {tuple(one.shape)}, but must be those of one camera")
        if not every:
            return cls((), torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0, 5))
        return cls(
            tuple((one.width, one.height) for one in every),
            torch.stack([one.focal for one in every]),
            torch.stack([one.principal_point for one in every]),
            torch.stack([one.distortion for one in every]),
        )

    def __len__(self) -> int:
        return len(self.sizes)

    def __getitem__(self, camera: int) -> Intrinsics:
        """The intrinsics of one."""
        return self._entries(camera, camera)

    def of_views(self, camera: Any) -> Intrinsics:
        """The intrinsics of views with the cameras `camera` (*B) as a batch (*B); not batched where there is one camera
        for all. Width and height are those of the first."""
        if len(self) == 1:
            return self[0]
        return self._entries(0, camera)

    def _entries(self, size: int, camera: Any) -> Intrinsics:
        focal, principal_point, distortion = self.focal[camera], self.principal_point[camera], self.distortion[camera]
        return Intrinsics(*self.sizes[size], focal, principal_point, distortion, check=False)

    def detached(self) -> "Cameras":
        """The same without a graph."""
        return Cameras(self.sizes, self.focal.detach(), self.principal_point.detach(), self.distortion.detach())


@dataclass(frozen=True, eq=False)
class Views:
    """A table of photographs by their names.

    pose: `cam_from_world`, meaningless where not registered. camera and interface: rows of the scene's tables.
    """

    names: tuple[str, ...]
    pose: Rigid
    camera: Int[Tensor, " m"]
    interface: Int[Tensor, " m"]
    registered: Bool[Tensor, " m"]

    @classmethod
    def posed(
        cls,
        pose: Rigid,
        names: Sequence[str] | None = None,
        camera: Int[Tensor, " m"] | None = None,
        interface: Int[Tensor, " m"] | None = None,
    ) -> "Views":
        """Registered views; by default with the names "0", "1" ..., the first camera and the first interface."""
        count, none = len(pose), torch.zeros(len(pose), dtype=torch.long, device=pose.center.device)
        return cls(
            tuple(map(str, range(count))) if names is None else tuple(names),
            pose,
            none if camera is None else camera,
            none if interface is None else interface,
            torch.ones(count, dtype=torch.bool, device=pose.center.device),
        )

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, view: Int[Tensor, " k"]) -> "Views":
        """Some of them, by their numbers."""
        names = tuple(self.names[i] for i in view.tolist())
        return Views(names, self.pose[view], self.camera[view], self.interface[view], self.registered[view])

    @property
    def rotation(self) -> Float[Tensor, "m 3 3"]:
        return self.pose.rotation

    @property
    def center(self) -> Float[Tensor, "m 3"]:
        return self.pose.center

    @property
    def num_registered(self) -> int:
        return int(self.registered.sum())

    def at(
        self, rotation: Float[Tensor, "k 3 3"], center: Float[Tensor, "k 3"], view: Int[Tensor, " k"] | None = None
    ) -> "Views":
        """Views `view`, by default all, registered at these poses."""
        if view is None:
            return replace(self, pose=Rigid(rotation, center), registered=torch.ones_like(self.registered))
        pose = Rigid(self.rotation.index_copy(0, view, rotation), self.center.index_copy(0, view, center))
        return replace(self, pose=pose, registered=self.registered.index_fill(0, view, True))


@dataclass(frozen=True, eq=False)
class Observations:
    """Points `point` seen in views `view` at `pixels`, each point at most once in a view.

    Those of one point are its track. Where they are part of a `Scene`, `point` ascends. weight: of each squared
    residual, by default 1.
    """

    view: Int[Tensor, " k"]
    point: Int[Tensor, " k"]
    pixels: Float[Tensor, "k 2"]
    weight: Float[Tensor, " k"] | None = None

    @classmethod
    def none(cls) -> "Observations":
        """Nothing was seen."""
        index = torch.zeros(0, dtype=torch.long)
        return cls(index, index, torch.zeros(0, 2, dtype=torch.float64))

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, rows: Shaped[Tensor, " j"] | slice) -> "Observations":
        """Some of them, by a mask or by their numbers."""
        weight = None if self.weight is None else self.weight[rows]
        return Observations(self.view[rows], self.point[rows], self.pixels[rows], weight)

    @property
    def weights(self) -> Float[Tensor, " k"]:
        """weight, or ones."""
        return torch.ones_like(self.pixels[:, 0]) if self.weight is None else self.weight

    def detached(self) -> "Observations":
        """The same without a graph."""
        weight = None if self.weight is None else self.weight.detach()
        return replace(self, pixels=self.pixels.detach(), weight=weight)
