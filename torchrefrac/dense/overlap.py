"""Which views may see what others show: a box around what each has found, as the cameras see its corners.

What lies in a box is seen within its corners; as water bends its edges, and a patch may lie beside the points that a
box was made of, it is made larger on all sides. Only what certainly is not seen is left out.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.patches import Patches

WIDER = 0.25  # of its size in an image, by which a box is made larger on each side


def may_see(camera: RefractiveCamera, low: Float[Tensor, "b 3"], high: Float[Tensor, "b 3"]) -> Bool[Tensor, " b"]:
    """Whether a single camera may see something of boxes from `low` to `high`.

    What has corners on either side of the camera counts as seen, what is behind it does not.
    """
    upper = torch.cartesian_prod(*(torch.tensor([False, True], device=low.device),) * 3)
    pixels, valid = camera.project(torch.where(upper, high[:, None], low[:, None]))
    least, most = pixels.amin(dim=1), pixels.amax(dim=1)
    room = WIDER * (most - least)
    size = pixels.new_tensor((camera.intrinsics.width, camera.intrinsics.height))
    inside = ((most + room > 0.0) & (least - room < size)).all(dim=-1)
    return torch.where(valid.all(dim=1), inside, valid.any(dim=1))


@dataclass(frozen=True)
class Finds:
    """Patches by the views that found them.

    rows of the patches, view by view; start: where those of each of m views begin, and the end; sees: whether a view
    may see what another one found.
    """

    patches: Patches
    rows: Int[Tensor, " n"]
    start: Int[Tensor, " ends"]
    sees: Bool[Tensor, "m m"]

    @classmethod
    def of(cls, patches: Patches, cameras: RefractiveCamera) -> "Finds":
        """cameras (m): of all views."""
        count, reference = cameras.shape[0], patches.reference
        start = torch.nn.functional.pad(reference.bincount(minlength=count).cumsum(dim=0), (1, 0))
        some = reference.unique()
        index = torch.searchsorted(some, reference)[:, None].expand(-1, 3)
        box = patches.points.new_zeros(len(some), 3)
        low, high = (box.scatter_reduce(0, index, patches.points, how, include_self=False) for how in ("amin", "amax"))
        sees = torch.zeros(count, count, dtype=torch.bool)
        for view in range(count):
            sees[view, some] = may_see(cameras[view], low, high)
        return cls(patches, reference.argsort(stable=True), start, sees)

    def found_by(self, view: int) -> Int[Tensor, " k"]:
        """The rows of the patches that a view found, in order."""
        return self.rows[self.start[view] : self.start[view + 1]]

    def seen_by(self, view: int) -> tuple[Int[Tensor, " k"], Patches]:
        """The patches that a view may see, and their rows, in order."""
        if bool(self.sees[view].logical_or(self.start.diff() == 0).all()):
            return torch.arange(len(self.patches)), self.patches
        found = self.sees[view].nonzero()[:, 0].tolist()
        rows = torch.cat([self.rows[:0], *map(self.found_by, found)]).sort().values
        return rows, self.patches[rows]
