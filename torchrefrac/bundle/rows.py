"""Reprojection errors and their derivatives in the layout of the solver: observations side by side, each number of
them in a row of its own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import Intrinsics, projection_parts
from torchrefrac.camera.jacobians import Axes
from torchrefrac.geometry import Plane
from torchrefrac.optim import LossName, RowLayout, in_cache, robust
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Observations, Scene
from torchrefrac.scene.interfaces import without_water

IMPOSSIBLE_PX = 1e3
POSE = ("rotation", "center")
WATER_WIDTH = {"index_ratio": 1, "plane_tilt": 2, "plane_height": 1}
WATER = {"index_ratio": "indices", "plane_tilt": "plane_tilt", "plane_height": "plane_height"}
BLOCK, COMPILED_BLOCK = 32768, 65536
Mask = Bool[Tensor, "..."] | None


class IntrinsicsUnknown(NamedTuple):
    """One kind of unknown of a camera: how many numbers it has, and of which block of derivatives it is made."""

    width: int
    block: str

    def of(self, by: Mapping[str, Axes], focal: Float[Tensor, "*camera 2"], axis: int) -> Sequence[Float[Tensor, " k"]]:
        """Derivatives of one pixel coordinate. That in the logarithm of the focal length is the focal length times
        that in itself, which differs from zero for the coordinate's own only."""
        parts = by[self.block][axis]
        return [focal[..., axis] * parts[axis]] if self.block == "focal" else parts[: self.width]


INTRINSICS = {
    "focal": IntrinsicsUnknown(1, "focal"),
    "principal_point": IntrinsicsUnknown(2, "principal_point"),
    "radial": IntrinsicsUnknown(2, "distortion"),
    "distortion": IntrinsicsUnknown(5, "distortion"),
}


def coefficients_of(intrinsics: Sequence[str]) -> int:
    """How many coefficients of distortion there must be for these (keys of INTRINSICS) to vary."""
    return 5 if any(INTRINSICS[name].block == "distortion" for name in intrinsics) else 0


@dataclass(frozen=True)
class RowModel:
    """What the rows depend on beside tensors. intrinsics, water: what varies, keys of INTRINSICS and of WATER."""

    intrinsics: tuple[str, ...] = ()
    water: tuple[str, ...] = ()
    loss: LossName = "huber"
    loss_scale: float = 0.25
    frozen_ratio: bool = False

    @property
    def layout(self) -> RowLayout:
        """Of the rows; intrinsics and water as one family each."""
        widths = (INTRINSICS[name].width for name in self.intrinsics), (WATER_WIDTH[name] for name in self.water)
        return RowLayout.of(*map(sum, widths))


def observation_rows(
    model: RowModel, scene: Scene, seen: Observations, compiled: bool = False, out: Float[Tensor, "..."] | None = None
) -> tuple[Float[Tensor, "2 row k"], Float[Tensor, ""]]:
    """Rows, weighted, and the cost of the observations `seen`, which need not be those of the scene.

    Per observation: derivatives in the pose (rotation, centre), in the intrinsics, in the water, in the point; the
    residual (projection minus pixel). The loss is of the reprojection error, and weighted as a whole. An impossible
    observation (behind the camera, say) weighs nothing and costs as much as one that is IMPOSSIBLE_PX off. out: where
    to write the rows, if its shape is theirs.
    """
    shape = (2, model.layout.size, len(seen))
    rows = out if out is not None and out.shape == shape else seen.pixels.new_empty(shape)
    cost = seen.pixels.new_zeros(())
    for here in in_cache(len(seen), COMPILED_BLOCK if compiled else BLOCK):
        if compiled:
            rho = _compiled()(rows[..., here], model, *_gathered(model, scene, seen[here]))
        else:
            (u, v), rho = _parts(model, *_gathered(model, scene, seen[here]))
            torch.stack(u, out=rows[0, :, here])
            torch.stack(v, out=rows[1, :, here])
        if seen.weight is not None:
            rows[..., here] *= seen.weight[here].sqrt()
            rho = rho * seen.weight[here]
        cost = cost + 0.5 * rho.sum()
    return rows, cost


def differentiable_rows(
    model: RowModel, scene: Scene, seen: Observations
) -> tuple[Float[Tensor, "2 unknowns k"], Float[Tensor, "2 k"]]:
    """Derivatives and residuals, not weighted, zero where impossible; with a graph."""
    rows, _ = _rows(replace(model, loss="squared"), *_gathered(model, scene, seen))
    return rows[:, :-1], rows[:, -1]


def _gathered(model: RowModel, scene: Scene, seen: Observations) -> tuple[Mask, *tuple[Float[Tensor, "..."], ...]]:
    """What `_parts` takes; of the one camera or interface of all views there is no copy, but of its offset where some
    points are dry."""
    views, interfaces = scene.views, scene.interfaces
    camera = scene.cameras.of_views(views.camera[seen.view], coefficients_of(model.intrinsics))
    interface = 0 if len(interfaces) == 1 else views.interface[seen.view]
    offset = interfaces.offset[interface]
    return (
        camera.fisheye,
        _look_up(views.rotation, seen.view),
        _look_up(views.center, seen.view),
        _look_up(scene.points, seen.point),
        seen.pixels,
        camera.focal,
        camera.principal_point,
        camera.distortion,
        interfaces.index_ratio[0],
        interfaces.normal[interface],
        offset if scene.dry is None else without_water(offset, scene.dry[seen.point]),
    )


def _look_up(table: Float[Tensor, "rows *entry"], index: Int[Tensor, " k"]) -> Float[Tensor, "k *entry"]:
    """table[index], with each component of the entries contiguous."""
    return table.flatten(1).T.contiguous().index_select(1, index).T.unflatten(1, table.shape[1:])


def _parts(
    model: RowModel,
    fisheye: Bool[Tensor, "*camera"] | None,
    rotation: Float[Tensor, "k 3 3"],
    center: Float[Tensor, "k 3"],
    points: Float[Tensor, "k 3"],
    pixels: Float[Tensor, "k 2"],
    focal: Float[Tensor, "*camera 2"],
    principal_point: Float[Tensor, "*camera 2"],
    distortion: Float[Tensor, "*camera c"],
    index_ratio: Float[Tensor, ""],
    normal: Float[Tensor, "*interface 3"],
    offset: Float[Tensor, "*place"],
) -> tuple[list[list[Float[Tensor, " k"]]], Float[Tensor, " k"]]:
    """The rows of u and those of v, and rho."""
    intrinsics = Intrinsics(1, 1, focal, principal_point, distortion, fisheye, check=False)
    interface = FlatInterface(index_ratio, plane=Plane(normal, offset, check=False), check=False)
    blocks = *(INTRINSICS[name].block for name in model.intrinsics), *(WATER[name] for name in model.water)
    wanted = (*POSE, "point", *blocks)
    pixel, valid, by = projection_parts(intrinsics, rotation, center, points, interface, wanted, model.frozen_ratio)
    residual = pixel[0] - pixels[:, 0], pixel[1] - pixels[:, 1]
    square = torch.addcmul(residual[0] * residual[0], residual[1], residual[1])
    rho, weight = robust(square, model.loss, model.loss_scale)
    impossible, _ = robust(square.new_tensor(IMPOSSIBLE_PX**2), model.loss, model.loss_scale)
    root = torch.where(valid, weight.sqrt(), 0.0)
    axes = []
    for axis in (0, 1):
        parts = [part for name in POSE for part in by[name][axis]]
        parts += [part for name in model.intrinsics for part in INTRINSICS[name].of(by, focal, axis)]
        parts += [part for name in model.water for part in by[WATER[name]][axis]]
        axes.append([part * root for part in (*parts, *by["point"][axis], residual[axis])])
    return axes, torch.where(valid, rho, impossible)


def _rows(
    model: RowModel, fisheye: Mask, *tensors: Float[Tensor, "..."]
) -> tuple[Float[Tensor, "2 row k"], Float[Tensor, " k"]]:
    axes, rho = _parts(model, fisheye, *tensors)
    return torch.stack([part for axis in axes for part in axis]).unflatten(0, (2, -1)), rho


def _write_rows(
    out: Float[Tensor, "2 row k"], model: RowModel, fisheye: Mask, *tensors: Float[Tensor, "..."]
) -> Float[Tensor, " k"]:
    rows, rho = _rows(model, fisheye, *tensors)
    out.copy_(rows)
    return rho


@cache
def _compiled() -> Callable[..., Float[Tensor, " k"]]:
    return torch.compile(_write_rows, dynamic=True)
