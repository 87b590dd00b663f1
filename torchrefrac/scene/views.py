"""Views: photographs with their poses, and which camera and interface each has."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.geometry import Rigid


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
        return Views(
            tuple(self.names[i] for i in view.tolist()),
            self.pose[view],
            self.camera[view],
            self.interface[view],
            self.registered[view],
        )

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
