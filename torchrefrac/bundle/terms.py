"""What is known besides the images, as residuals: measured gravity, positions, heights, coordinates, lengths.

Every residual is divided by its standard deviation; the adjustment multiplies it by that of a keypoint, so that all
costs are in squared pixels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.rows import INTRINSICS, MEDIA
from torchrefrac.checks import Range, require_ranges
from torchrefrac.geometry import Plane, rotate, skew
from torchrefrac.numerics import like
from torchrefrac.scene import Cameras, Interfaces, Scene


class Residuals(NamedTuple):
    """Residuals in standard deviations, their derivatives, and which reduced unknowns these are in."""

    value: Float[Tensor, "k numbers"]
    jacobian: Float[Tensor, "k numbers width"]
    columns: Int[Tensor, "k width"]


class Term(Protocol):
    """One kind of measurement. Lengths are in the unit of the scene."""

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        """How far the scene is from what was measured."""
        ...


@dataclass(frozen=True)
class GravityPrior:
    """Unit directions down_in_cam of all views, or of `view`; expected error `sigma`, radians. up: the vertical in the
    world, a unit vector; None: z."""

    down_in_cam: Float[Tensor, "k 3"]
    sigma: float | Float[Tensor, "*k"]
    view: Int[Tensor, " k"] | None = None
    up: Float[Tensor, "3"] | None = None

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        """Errors -R up - down; the derivative in a left perturbation is -[-R up]x."""
        rotation = scene.views.rotation
        view = torch.arange(len(rotation), device=rotation.device) if self.view is None else self.view
        predicted = -rotation[view][:, :, 2] if self.up is None else -rotate(rotation[view], self.up.to(rotation))
        sigma = like(self.sigma, predicted).reshape(-1, 1)
        value, jacobian = (predicted - self.down_in_cam) / sigma, -skew(predicted) / sigma[..., None]
        return Residuals(value, jacobian, layout.pose_columns(view)[:, :3])


@dataclass(frozen=True)
class CenterPrior:
    """Positions of the centres of `view`, as from GNSS, in the unit of the scene; information is the inverse
    covariance."""

    view: Int[Tensor, " k"]
    position: Float[Tensor, "k 3"]
    information: Float[Tensor, "k 3 3"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        error = scene.views.center[self.view] - self.position
        return _weighed(error, self.information, layout.pose_columns(self.view)[:, 3:])


@dataclass(frozen=True)
class HeightPrior:
    """Heights of the centres of `view` above their interfaces, with standard deviations sigma, in the unit of the
    scene."""

    view: Int[Tensor, " k"]
    height: Float[Tensor, " k"]
    sigma: Float[Tensor, " k"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        which = layout.interface[self.view]
        above, jacobian = _above_plane(scene, which, scene.views.center[self.view])
        columns = torch.cat((layout.pose_columns(self.view)[:, 3:], layout.plane_columns(which)), dim=1)
        return _scalar(above - self.height, jacobian, columns, self.sigma)


@dataclass(frozen=True)
class KnownPoints:
    """Known coordinates of `point`, as of ground control, in the unit of the scene; information is the inverse
    covariance."""

    point: Int[Tensor, " k"]
    position: Float[Tensor, "k 3"]
    information: Float[Tensor, "k 3 3"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        error = scene.points[self.point] - self.position
        return _weighed(error, self.information, layout.point_columns(self.point))


@dataclass(frozen=True)
class ScaleBars:
    """Measured distances `length` between points first and second, with standard deviations sigma, in the unit of the
    scene."""

    first: Int[Tensor, " k"]
    second: Int[Tensor, " k"]
    length: Float[Tensor, " k"]
    sigma: Float[Tensor, " k"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        apart = scene.points[self.second] - scene.points[self.first]
        distance = apart.norm(dim=-1)
        along = apart / distance.clamp(min=torch.finfo(apart.dtype).tiny)[:, None]
        columns = torch.cat((layout.point_columns(self.first), layout.point_columns(self.second)), dim=1)
        return _scalar(distance - self.length, torch.cat((-along, along), dim=1), columns, self.sigma)


@dataclass(frozen=True)
class Waterline:
    """Points that lie on the interfaces `interface`, with standard deviations sigma in the unit of the scene."""

    point: Int[Tensor, " k"]
    interface: Int[Tensor, " k"]
    sigma: Float[Tensor, " k"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        above, jacobian = _above_plane(scene, self.interface, scene.points[self.point])
        columns = torch.cat((layout.point_columns(self.point), layout.plane_columns(self.interface)), dim=1)
        return _scalar(above, jacobian, columns, self.sigma)


@dataclass(frozen=True)
class WaterLevels:
    """Places that lie on the interfaces `interface`, as by a gauge, with standard deviations sigma in the unit of the
    scene."""

    interface: Int[Tensor, " k"]
    position: Float[Tensor, "k 3"]
    sigma: Float[Tensor, " k"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        above, jacobian = _above_plane(scene, self.interface, self.position)
        return _scalar(above, jacobian[:, 3:], layout.plane_columns(self.interface), self.sigma)


@dataclass(frozen=True)
class WaterSlope:
    """Interfaces that rise along horizontal unit vectors `along` by nothing, with standard deviations sigma, length
    over length."""

    along: Float[Tensor, "k 3"]
    sigma: Float[Tensor, " k"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        """The normal n . along; with tangents t1 and t2, about which it turns, its derivative is (-t2, t1) . along."""
        first, second = scene.interfaces.planes.tangents_like(self.along)
        scaled = (self.along / self.sigma[:, None]).mT
        jacobian = torch.stack((-second @ scaled, first @ scaled), dim=-1)
        columns = layout.plane_columns(layout.interfaces)[:, :2]
        return Residuals(scene.interfaces.normal @ scaled, jacobian, columns)


@dataclass(frozen=True)
class Expectations:
    """Standard deviations of the start's intrinsics and water; None: nothing is known.

    focal: relative; principal_point: pixels; distortion: of every coefficient; index_ratio and layer_index;
    plane_tilt_deg: degrees; layer_thickness and plane_height: in the unit of the scene.
    """

    focal: float | None = None
    principal_point: float | None = None
    distortion: float | None = None
    index_ratio: float | None = None
    plane_tilt_deg: float | None = None
    plane_height: float | None = None
    layer_index: float | None = None
    layer_thickness: float | None = None

    def __post_init__(self) -> None:
        require_ranges(self, {each.name: Range(above=0.0, at_most=1e6) for each in fields(self)})

    def sigma_of(self, name: str) -> float | None:
        """Of a kind of unknown (keys of `rows.INTRINSICS` and `rows.WATER`), tilts in radians."""
        if name == "plane_tilt":
            return None if self.plane_tilt_deg is None else self.plane_tilt_deg * torch.pi / 180.0
        return self.distortion if name == "radial" else getattr(self, name)


@dataclass(frozen=True)
class GlobalPrior:
    """One kind of unknown of the intrinsics or the water stays near what it is in `start`, with standard deviation
    `sigma`, or one for each camera, infinite where nothing is known."""

    name: str
    start: Scene
    sigma: float | Float[Tensor, " g"]

    def residuals(self, scene: Scene, layout: Layout) -> Residuals:
        if self.name in INTRINSICS:
            value = self._intrinsics(scene.cameras) - self._intrinsics(self.start.cameras)
            columns = layout.intrinsics_columns(self.name, layout.cameras)
            return self._scaled(value, torch.eye(value.shape[1], dtype=value.dtype, device=value.device), columns)
        new, old = scene.interfaces, self.start.interfaces
        if self.name in MEDIA:
            value = (_medium(new, self.name) - _medium(old, self.name))[None, None]
            columns = torch.full((1, 1), layout.medium_column(self.name), device=value.device)
            return self._scaled(value, torch.ones_like(value), columns)
        columns = layout.plane_columns(layout.interfaces)
        if self.name == "plane_height":
            value = (new.offset - old.offset)[:, None]
            return self._scaled(value, torch.ones_like(value)[..., None], columns[:, 2:])
        first0, second0 = old.planes.tangents_like(scene.views.center)
        first, second = new.planes.tangents_like(scene.views.center)
        value = torch.stack((-(second0 * new.normal).sum(-1), (first0 * new.normal).sum(-1)), dim=-1)
        by_first = torch.stack(((second0 * second).sum(-1), -(first0 * second).sum(-1)), dim=-1)
        by_second = torch.stack((-(second0 * first).sum(-1), (first0 * first).sum(-1)), dim=-1)
        return self._scaled(value, torch.stack((by_first, by_second), dim=-1), columns[:, :2])

    def _intrinsics(self, cameras: Cameras) -> Float[Tensor, "g width"]:
        if self.name == "focal":
            return cameras.focal[:, :1].log()
        if self.name == "principal_point":
            return cameras.principal_point
        return cameras.distortion[:, : INTRINSICS[self.name].width]

    def _scaled(
        self, value: Float[Tensor, "k numbers"], jacobian: Float[Tensor, "*#k width"], columns: Int[Tensor, "k width"]
    ) -> Residuals:
        jacobian = jacobian.expand(len(value), value.shape[1], -1)
        sigma = like(self.sigma, value).reshape(-1, 1)
        return Residuals(value / sigma, jacobian / sigma[..., None], columns)


def _medium(interfaces: Interfaces, name: str) -> Float[Tensor, ""]:
    """One of MEDIA, of the first interface that has it."""
    if name == "index_ratio":
        return interfaces.index_ratio[0]
    first = interfaces.thickness[:, 0].argmax()
    return (interfaces.layers if name == "layer_index" else interfaces.thickness)[first, 0]


def expectations(scene: Scene, layout: Layout, expected: Expectations) -> list[GlobalPrior]:
    """What is known beforehand of what varies: of cameras as they state it, or else as `expected`."""
    cameras, terms = scene.cameras, []
    stated = scene if cameras.stated is None else replace(scene, cameras=cameras.stated)
    for name in layout.intrinsics:
        sigma = prior_sigmas(cameras, name, expected)
        if bool(sigma.isfinite().any()):
            terms.append(GlobalPrior(name, stated, sigma))
    interfaces = scene.interfaces
    as_stated = scene if interfaces.stated is None else replace(scene, interfaces=interfaces.stated)
    for name in layout.water:
        if name in interfaces.sigmas:
            terms.append(GlobalPrior(name, as_stated, interfaces.sigmas[name]))
        elif (sigma := expected.sigma_of(name)) is not None:
            terms.append(GlobalPrior(name, scene, sigma))
    return terms


def prior_sigmas(cameras: Cameras, name: str, expected: Expectations) -> Float[Tensor, " g"]:
    """Standard deviation of a kind of unknown of each camera before an adjustment; infinite: nothing is known."""
    own, otherwise = cameras.sigma_of("distortion" if name == "radial" else name), expected.sigma_of(name)
    return torch.where(own > 0.0, own, math.inf if otherwise is None else otherwise)


def concerned_points(terms: Sequence[Term], points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"] | None:
    """Mask of the points that measurements of their own concern; None where there are none."""
    parts = []
    for term in terms:
        if isinstance(term, KnownPoints | Waterline):
            parts.append(term.point)
        elif isinstance(term, ScaleBars):
            parts += [term.first, term.second]
    if not parts:
        return None
    mask = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    mask[torch.cat(parts)] = True
    return mask


def _above_plane(
    scene: Scene, which: Int[Tensor, " k"], position: Float[Tensor, "k 3"]
) -> tuple[Float[Tensor, " k"], Float[Tensor, "k 6"]]:
    """Heights of positions above interfaces `which`, and their derivatives in the position and in the tilts and the
    height of the plane (see `Plane.moved`)."""
    normal, offset = scene.interfaces.normal[which], scene.interfaces.offset[which]
    first, second = Plane(normal, offset, check=False).tangents_like(position)
    by_plane = torch.stack((-(second * position).sum(-1), (first * position).sum(-1), -torch.ones_like(offset)), dim=-1)
    return (normal * position).sum(-1) - offset, torch.cat((normal, by_plane), dim=1)


def _scalar(
    value: Float[Tensor, " k"],
    jacobian: Float[Tensor, "k width"],
    columns: Int[Tensor, "k width"],
    sigma: Float[Tensor, " k"],
) -> Residuals:
    return Residuals((value / sigma)[:, None], (jacobian / sigma[:, None])[:, None], columns)


def _weighed(
    error: Float[Tensor, "k 3"], information: Float[Tensor, "k 3 3"], columns: Int[Tensor, "k 3"]
) -> Residuals:
    """Of errors with inverse covariances W^T W = information."""
    root = torch.linalg.cholesky_ex(information)[0].mT
    return Residuals((root @ error[..., None])[..., 0], root, columns)
