"""Reprojection errors and their derivatives in the layout of the solver: N observations side by side, each number of
them in a row of its own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.bundle.state import BundleState, Links, Observations
from torchrefrac.camera import Intrinsics, projection_parts
from torchrefrac.camera.jacobians import Axes
from torchrefrac.geometry import Plane
from torchrefrac.optim import LossName, robust
from torchrefrac.optim.normal_equations import in_cache
from torchrefrac.refraction import FlatInterface

IMPOSSIBLE_PX = 1e3
POSE = ("rotation", "center")
WATER_WIDTH = {"index_ratio": 1, "plane_tilt": 2, "plane_height": 1}
WATER = {"index_ratio": "indices", "plane_tilt": "plane_tilt", "plane_height": "plane_height"}
BLOCK, COMPILED_BLOCK = 32768, 65536


class LensUnknown(NamedTuple):
    """One kind of unknown of a lens: how many numbers it has, and of which block of derivatives it is made."""

    width: int
    block: str

    def of(self, by: Mapping[str, Axes], focal: Tensor, axis: int) -> Sequence[Tensor]:
        """Derivatives of one pixel coordinate. That in the logarithm of the focal length is the focal length times
        that in itself, which differs from zero for the coordinate's own only."""
        parts = by[self.block][axis]
        return [focal[..., axis] * parts[axis]] if self.block == "focal" else parts[: self.width]


LENS = {
    "focal": LensUnknown(1, "focal"),
    "principal_point": LensUnknown(2, "principal_point"),
    "radial": LensUnknown(2, "distortion"),
    "distortion": LensUnknown(5, "distortion"),
}


@dataclass(frozen=True)
class RowModel:
    """What the rows depend on beside tensors. lens, water: names of the unknowns, keys of LENS and of WATER."""

    lens: tuple[str, ...] = ()
    water: tuple[str, ...] = ()
    loss: LossName = "huber"
    loss_scale: float = 0.25
    frozen_ratio: bool = False

    @property
    def width(self) -> int:
        """How many unknowns an observation depends on beside its point's."""
        return 6 + sum(LENS[name].width for name in self.lens) + sum(WATER_WIDTH[name] for name in self.water)


def observation_rows(
    model: RowModel,
    state: BundleState,
    links: Links,
    seen: Observations,
    compiled: bool = False,
    out: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Rows (2, width + 4, N), weighted, and the cost of the observations, a scalar.

    Per observation: derivatives in the pose (rotation, centre), in the lens, in the water, in the point; the residual
    (projection minus pixel). The loss is of the reprojection error, and weighted as a whole. An impossible observation
    (behind the camera, say) weighs nothing and costs as much as one that is IMPOSSIBLE_PX off. out: where to write the
    rows, if its shape is theirs.
    """
    tables = _Tables.of(state, links)
    shape = (2, model.width + 4, len(seen))
    rows = out if out is not None and out.shape == shape else seen.pixels.new_empty(shape)
    cost = seen.pixels.new_zeros(())
    for here in in_cache(len(seen), COMPILED_BLOCK if compiled else BLOCK):
        if compiled:
            rho = _compiled()(rows[..., here], model, *tables.gather(seen[here]))
        else:
            (u, v), rho = _parts(model, *tables.gather(seen[here]))
            torch.stack(u, out=rows[0, :, here])
            torch.stack(v, out=rows[1, :, here])
        if seen.weight is not None:
            rows[..., here] *= seen.weight[here].sqrt()
            rho = rho * seen.weight[here]
        cost = cost + 0.5 * rho.sum()
    return rows, cost


def differentiable_rows(model: RowModel, state: BundleState, links: Links, seen: Observations) -> tuple[Tensor, Tensor]:
    """Derivatives (2, width + 3, N) and residuals (2, N), not weighted, zero where impossible: both with a graph."""
    rows, _ = _rows(replace(model, loss="squared"), *_Tables.of(state, links).gather(seen))
    return rows[:, :-1], rows[:, -1]


@dataclass(frozen=True)
class _Tables:
    """State and links, ready to be looked up. single: whether there is one lens, one plane."""

    state: BundleState
    links: Links
    one_lens: bool
    one_plane: bool

    @classmethod
    def of(cls, state: BundleState, links: Links) -> "_Tables":
        return cls(state, links, not state.lens.shape or state.lens.shape[0] == 1, len(state.planes[0]) == 1)

    def gather(self, seen: Observations) -> tuple[Tensor, ...]:
        """rotation, center, points, pixels, focal, principal_point, distortion, index_ratio, normal, offset."""
        state, camera = self.state, seen.camera
        lens = [state.lens.focal, state.lens.principal_point, state.lens.distortion]
        planes = list(state.planes)
        if self.one_lens:
            lens = [value.reshape(-1) for value in lens]
        else:
            lens = [value[self.links.lens[camera]] for value in lens]
        planes = [value[0] if self.one_plane else value[self.links.plane[camera]] for value in planes]
        return (
            _look_up(state.rotation, camera),
            _look_up(state.center, camera),
            _look_up(state.points, seen.point),
            seen.pixels,
            *lens,
            state.index_ratio,
            *planes,
        )


def _look_up(table: Tensor, index: Tensor) -> Tensor:
    """table[index], with each component of the entries contiguous."""
    return table.flatten(1).T.contiguous().index_select(1, index).T.unflatten(1, table.shape[1:])


def _parts(
    model: RowModel,
    rotation: Tensor,
    center: Tensor,
    points: Tensor,
    pixels: Tensor,
    focal: Tensor,
    principal_point: Tensor,
    distortion: Tensor,
    index_ratio: Tensor,
    normal: Tensor,
    offset: Tensor,
) -> tuple[list[list[Tensor]], Tensor]:
    """The rows of u and those of v (N each), and rho (N)."""
    lens = Intrinsics(1, 1, focal, principal_point, distortion, check=False)
    interface = FlatInterface(index_ratio, plane=Plane(normal, offset, check=False), check=False)
    wanted = (*POSE, "point", *(LENS[name].block for name in model.lens), *(WATER[name] for name in model.water))
    pixel, valid, by = projection_parts(lens, rotation, center, points, interface, wanted, model.frozen_ratio)
    residual = pixel[0] - pixels[:, 0], pixel[1] - pixels[:, 1]
    square = torch.addcmul(residual[0] * residual[0], residual[1], residual[1])
    rho, weight = robust(square, model.loss, model.loss_scale)
    impossible, _ = robust(square.new_tensor(IMPOSSIBLE_PX**2), model.loss, model.loss_scale)
    root = torch.where(valid, weight.sqrt(), 0.0)
    axes = []
    for axis in (0, 1):
        parts = [part for name in POSE for part in by[name][axis]]
        parts += [part for name in model.lens for part in LENS[name].of(by, focal, axis)]
        parts += [part for name in model.water for part in by[WATER[name]][axis]]
        axes.append([part * root for part in (*parts, *by["point"][axis], residual[axis])])
    return axes, torch.where(valid, rho, impossible)


def _rows(model: RowModel, *tensors: Tensor) -> tuple[Tensor, Tensor]:
    axes, rho = _parts(model, *tensors)
    return torch.stack([part for axis in axes for part in axis]).unflatten(0, (2, -1)), rho


def _write_rows(out: Tensor, model: RowModel, *tensors: Tensor) -> Tensor:
    rows, rho = _rows(model, *tensors)
    out.copy_(rows)
    return rho


@cache
def _compiled() -> Callable[..., Tensor]:
    return torch.compile(_write_rows, dynamic=True)
