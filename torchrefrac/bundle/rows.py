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
from torchrefrac.numerics import columns_at
from torchrefrac.optim import LossName, RowLayout, in_cache, robust
from torchrefrac.optim.loss import BENDING, turned
from torchrefrac.scene import Interfaces, Observations, Scene
from torchrefrac.scene.interfaces import layered, without_water

IMPOSSIBLE_PX = 1e3
POSE = ("rotation", "center")
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


class WaterUnknown(NamedTuple):
    """One kind of unknown of the interfaces: how many numbers it has, of which block of derivatives it is made, and
    which of its numbers that is, where the block has more. shared: whether all interfaces have it in common."""

    width: int
    block: str
    shared: bool = False
    at: int | None = None

    def of(
        self, by: Mapping[str, Axes], axis: int, thickness: Float[Tensor, "*interface inner"]
    ) -> Sequence[Float[Tensor, " k"]]:
        """Derivatives of one pixel coordinate; none in the thickness of a layer that an interface has not."""
        parts = by[self.block][axis]
        parts = parts if self.at is None else [parts[self.at]]
        return [torch.where(thickness[..., 0] > 0.0, parts[0], 0.0)] if self.block == "thickness" else parts


WATER = {
    "index_ratio": WaterUnknown(1, "indices", shared=True, at=-1),
    "layer_index": WaterUnknown(1, "indices", shared=True, at=0),
    "layer_thickness": WaterUnknown(1, "thickness", shared=True, at=0),
    "plane_tilt": WaterUnknown(2, "plane_tilt"),
    "plane_height": WaterUnknown(1, "plane_height"),
}
MEDIA = tuple(name for name, unknown in WATER.items() if unknown.shared)
OF_LAYERS = ("layer_index", "layer_thickness")


def water_unknowns(interfaces: Interfaces) -> tuple[str, ...]:
    """Keys of WATER that interfaces have: those of layers where there is one kind of layer."""
    return tuple(name for name in WATER if name not in OF_LAYERS or interfaces.layers.shape[-1] == 1)


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
    moves_with_camera: bool = False

    @property
    def layout(self) -> RowLayout:
        """Of the rows; intrinsics and water as one family each."""
        widths = (INTRINSICS[name].width for name in self.intrinsics), (WATER[name].width for name in self.water)
        return RowLayout.of(*map(sum, widths))


class _Weights(NamedTuple):
    """What the two rows of an observation are multiplied by: each by a number of its own, and what it takes from the
    other by a third, where there is one."""

    own: tuple[Float[Tensor, " k"], Float[Tensor, " k"]]
    other: Float[Tensor, " k"] | None

    @classmethod
    def of(
        cls,
        root: Float[Tensor, " k"],
        residual: tuple[Float[Tensor, " k"], Float[Tensor, " k"]],
        bend: Float[Tensor, " k"],
    ) -> "_Weights":
        """The matrix root (I - bend r r') of residuals r."""
        bent = root * bend * residual[0], root * bend * residual[1]
        own = (
            torch.addcmul(root, bent[0], residual[0], value=-1.0),
            torch.addcmul(root, bent[1], residual[1], value=-1.0),
        )
        return cls(own, -bent[0] * residual[1])

    def weigh(
        self, parts: Sequence[Float[Tensor, " k"]], axis: int, out: Float[Tensor, " k"] | None = None
    ) -> Float[Tensor, " k"]:
        """Of a column of both rows, what stands in that of an axis."""
        weighted = torch.mul(parts[axis], self.own[axis], out=out)
        return weighted if self.other is None else weighted.addcmul_(parts[1 - axis], self.other)


def observation_rows(
    model: RowModel, scene: Scene, seen: Observations, compiled: bool = False, out: Float[Tensor, "..."] | None = None
) -> tuple[Float[Tensor, "2 row k"], Float[Tensor, ""]]:
    """Rows, weighted, and the cost of the observations `seen`, which need not be those of the scene.

    Per observation: derivatives in the pose (rotation, centre), in the intrinsics, in the water, in the point; the
    residual (projection minus pixel), all over the noise of the pixel. The loss is of the reprojection error over its
    noise, and weighted as a whole. An impossible observation (behind the camera, say) weighs nothing and costs as much
    as one that is IMPOSSIBLE_PX off. out: where to write the rows, if its shape is theirs.
    """
    shape = (2, model.layout.size, len(seen))
    rows = out if out is not None and out.shape == shape else seen.pixels.new_empty(shape)
    cost = seen.pixels.new_zeros(())
    for here in in_cache(len(seen), COMPILED_BLOCK if compiled else BLOCK):
        if compiled:
            rho = _compiled()(rows[..., here], model, *_gathered(model, scene, seen[here]))
        else:
            axes, weights, rho = _parts(model, *_gathered(model, scene, seen[here]))
            for number, parts in enumerate(zip(*axes, strict=True)):
                for axis in (0, 1):
                    weights.weigh(parts, axis, rows[axis, number, here])
        if seen.weight is not None:
            rows[..., here] *= seen.weight[here].sqrt()
            rho = rho * seen.weight[here]
        cost = cost + 0.5 * rho.sum()
    return rows, cost


def differentiable_rows(
    model: RowModel, scene: Scene, seen: Observations
) -> tuple[Float[Tensor, "2 unknowns k"], Float[Tensor, "2 k"]]:
    """Derivatives and residuals over their noise, not weighted, zero where impossible; with a graph."""
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
        interfaces.layers[interface],
        interfaces.thickness[interface],
        seen.precision,
    )


def _look_up(table: Float[Tensor, "rows *entry"], index: Int[Tensor, " k"]) -> Float[Tensor, "k *entry"]:
    """table[index], with each component of the entries contiguous."""
    return columns_at(table.flatten(1).T.contiguous(), index).T.unflatten(1, table.shape[1:])


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
    layers: Float[Tensor, "*interface inner"],
    thickness: Float[Tensor, "*interface inner"],
    precision: Float[Tensor, "*precision"],
) -> tuple[list[list[Float[Tensor, " k"]]], _Weights, Float[Tensor, " k"]]:
    """The rows of u and those of v, how they are to be weighted, and rho."""
    intrinsics = Intrinsics(1, 1, focal, principal_point, distortion, fisheye, check=False)
    media, plane = (layers.unbind(dim=-1), thickness.unbind(dim=-1)), Plane(normal, offset, check=False)
    interface = layered(index_ratio, *media, plane, model.moves_with_camera)
    blocks = [(INTRINSICS | WATER)[name].block for name in (*model.intrinsics, *model.water)]
    wanted = (*POSE, "point", *blocks)
    pixel, valid, by = projection_parts(intrinsics, rotation, center, points, interface, wanted, model.frozen_ratio)
    residual = pixel[0] - pixels[:, 0], pixel[1] - pixels[:, 1]
    square = torch.addcmul(residual[0] * residual[0], residual[1], residual[1]) * precision.square()
    rho, weight = robust(square, model.loss, model.loss_scale)
    impossible, _ = robust(square.new_full((), IMPOSSIBLE_PX**2), model.loss, model.loss_scale)
    root = torch.where(valid, weight.sqrt() * precision, 0.0)
    weights = _Weights((root, root), None)
    if model.loss in BENDING:
        bend, longer = turned(residual, weight, model.loss)
        weights = _Weights.of(root, residual, bend)
        residual = residual[0] * longer, residual[1] * longer
    axes = []
    for axis in (0, 1):
        parts = [part for name in POSE for part in by[name][axis]]
        parts += [part for name in model.intrinsics for part in INTRINSICS[name].of(by, focal, axis)]
        parts += [part for name in model.water for part in WATER[name].of(by, axis, thickness)]
        axes.append([*parts, *by["point"][axis], residual[axis]])
    return axes, weights, torch.where(valid, rho, impossible)


def _rows(
    model: RowModel, fisheye: Mask, *tensors: Float[Tensor, "..."]
) -> tuple[Float[Tensor, "2 row k"], Float[Tensor, " k"]]:
    axes, weights, rho = _parts(model, fisheye, *tensors)
    each = [torch.stack([weights.weigh(parts, axis) for parts in zip(*axes, strict=True)]) for axis in (0, 1)]
    return torch.stack(each), rho


def _write_rows(
    out: Float[Tensor, "2 row k"], model: RowModel, fisheye: Mask, *tensors: Float[Tensor, "..."]
) -> Float[Tensor, " k"]:
    rows, rho = _rows(model, fisheye, *tensors)
    out.copy_(rows)
    return rho


@cache
def _compiled() -> Callable[..., Float[Tensor, " k"]]:
    return torch.compile(_write_rows, dynamic=True)
