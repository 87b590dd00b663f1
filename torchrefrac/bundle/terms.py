"""What is known besides the images, as residuals: measured gravity, positions, heights, coordinates, lengths.

Every residual is divided by its standard deviation; the adjustment multiplies it by that of a keypoint, so that all
costs are in squared pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.rows import LENS
from torchrefrac.bundle.state import BundleState
from torchrefrac.geometry import Plane, skew


class Residuals(NamedTuple):
    """K residuals of r numbers, in standard deviations (K, r), their derivatives (K, r, w), and which reduced unknowns
    these are in (K, w)."""

    value: Tensor
    jacobian: Tensor
    columns: Tensor


class Term(Protocol):
    """One kind of measurement."""

    def residuals(self, state: BundleState, layout: Layout) -> Residuals: ...


@dataclass(frozen=True)
class GravityPrior:
    """Unit directions down_in_cam (m, 3) of all images, or (k, 3) of `image` (k); expected error `sigma`, radians."""

    down_in_cam: Tensor
    sigma: float | Tensor
    image: Tensor | None = None

    def residuals(self, state: BundleState, layout: Layout) -> Residuals:
        """R (0, 0, -1) - down; the derivative in a left perturbation is -[R (0, 0, -1)]x."""
        image = _all_or(self.image, state.center)
        predicted = -state.rotation[image][:, :, 2]
        sigma = torch.as_tensor(self.sigma, dtype=predicted.dtype, device=predicted.device).reshape(-1, 1)
        value, jacobian = (predicted - self.down_in_cam) / sigma, -skew(predicted) / sigma[..., None]
        return Residuals(value, jacobian, layout.pose_columns(image)[:, :3])


@dataclass(frozen=True)
class CenterPrior:
    """Positions (k, 3) of the centres of `image` (k), as from GNSS; information (k, 3, 3) is the inverse covariance."""

    image: Tensor
    position: Tensor
    information: Tensor

    def residuals(self, state: BundleState, layout: Layout) -> Residuals:
        error = state.center[self.image] - self.position
        return _weighed(error, self.information, layout.pose_columns(self.image)[:, 3:])


@dataclass(frozen=True)
class HeightPrior:
    """Heights (k) of the centres of `image` (k) above their water plane, with standard deviations sigma (k)."""

    image: Tensor
    height: Tensor
    sigma: Tensor

    def residuals(self, state: BundleState, layout: Layout) -> Residuals:
        which = layout.links.plane[self.image]
        above, jacobian = _above_plane(state, which, state.center[self.image])
        columns = torch.cat((layout.pose_columns(self.image)[:, 3:], layout.plane_columns(which)), dim=1)
        return _scalar(above - self.height, jacobian, columns, self.sigma)


@dataclass(frozen=True)
class KnownPoints:
    """Known coordinates (k, 3) of `point` (k), as of ground control; information (k, 3, 3)."""

    point: Tensor
    position: Tensor
    information: Tensor

    def residuals(self, state: BundleState, layout: Layout) -> Residuals:
        error = state.points[self.point] - self.position
        return _weighed(error, self.information, layout.point_columns(self.point))


@dataclass(frozen=True)
class ScaleBars:
    """Measured distances `length` (k) between points first (k) and second (k), standard deviations sigma (k)."""

    first: Tensor
    second: Tensor
    length: Tensor
    sigma: Tensor

    def residuals(self, state: BundleState, layout: Layout) -> Residuals:
        apart = state.points[self.second] - state.points[self.first]
        distance = apart.norm(dim=-1)
        along = apart / distance.clamp(min=torch.finfo(apart.dtype).tiny)[:, None]
        columns = torch.cat((layout.point_columns(self.first), layout.point_columns(self.second)), dim=1)
        return _scalar(distance - self.length, torch.cat((-along, along), dim=1), columns, self.sigma)


@dataclass(frozen=True)
class Waterline:
    """Points (k) that lie on the water plane `plane` (k), with standard deviations sigma (k)."""

    point: Tensor
    plane: Tensor
    sigma: Tensor

    def residuals(self, state: BundleState, layout: Layout) -> Residuals:
        above, jacobian = _above_plane(state, self.plane, state.points[self.point])
        columns = torch.cat((layout.point_columns(self.point), layout.plane_columns(self.plane)), dim=1)
        return _scalar(above, jacobian, columns, self.sigma)


@dataclass(frozen=True)
class Expectations:
    """Standard deviations of what the start says of the lens and of the water; None: nothing is known.

    focal: relative; principal_point: pixels; distortion: of every coefficient; index_ratio; plane_tilt_deg: degrees;
    plane_height: in the unit of the scene.
    """

    focal: float | None = None
    principal_point: float | None = None
    distortion: float | None = None
    index_ratio: float | None = None
    plane_tilt_deg: float | None = None
    plane_height: float | None = None

    def sigma_of(self, name: str) -> float | None:
        """Of a kind of unknown (keys of `rows.LENS` and `layout.WATER_WIDTH`), tilts in radians."""
        if name == "plane_tilt":
            return None if self.plane_tilt_deg is None else self.plane_tilt_deg * torch.pi / 180.0
        return self.distortion if name == "radial" else getattr(self, name)


@dataclass(frozen=True)
class GlobalPrior:
    """One kind of unknown of the lens or the water stays near what `start` says, with standard deviation `sigma`."""

    name: str
    start: BundleState
    sigma: float

    def residuals(self, state: BundleState, layout: Layout) -> Residuals:
        if self.name in LENS:
            value = self._lens(state) - self._lens(self.start)
            columns = layout.lens_columns(self.name, torch.arange(layout.num_lenses, device=value.device))
            return self._scaled(value, torch.eye(value.shape[1], dtype=value.dtype, device=value.device), columns)
        if self.name == "index_ratio":
            value = (state.index_ratio - self.start.index_ratio).reshape(1, 1)
            columns = torch.full((1, 1), layout.index_column(), device=value.device)
            return self._scaled(value, torch.ones_like(value), columns)
        columns = layout.plane_columns(torch.arange(layout.num_planes, device=state.center.device))
        if self.name == "plane_height":
            value = (state.planes[1] - self.start.planes[1])[:, None]
            return self._scaled(value, torch.ones_like(value)[..., None], columns[:, 2:])
        first0, second0 = Plane(*self.start.planes, check=False).tangents_like(state.center)
        first, second = Plane(*state.planes, check=False).tangents_like(state.center)
        normal = state.planes[0]
        value = torch.stack((-(second0 * normal).sum(-1), (first0 * normal).sum(-1)), dim=-1)
        by_first = torch.stack(((second0 * second).sum(-1), -(first0 * second).sum(-1)), dim=-1)
        by_second = torch.stack((-(second0 * first).sum(-1), (first0 * first).sum(-1)), dim=-1)
        return self._scaled(value, torch.stack((by_first, by_second), dim=-1), columns[:, :2])

    def _lens(self, state: BundleState) -> Tensor:
        lens = state.lens
        if self.name == "focal":
            return lens.focal.reshape(-1, 2)[:, :1].log()
        if self.name == "principal_point":
            return lens.principal_point.reshape(-1, 2)
        return lens.distortion.reshape(-1, 5)[:, : LENS[self.name].width]

    def _scaled(self, value: Tensor, jacobian: Tensor, columns: Tensor) -> Residuals:
        jacobian = jacobian.expand(len(value), value.shape[1], -1)
        return Residuals(value / self.sigma, jacobian / self.sigma, columns)


def concerned_points(terms: Sequence[Term], num_points: int, like: Tensor) -> Tensor | None:
    """Mask (n) of the points that measurements of their own concern; None where there are none."""
    parts = []
    for term in terms:
        if isinstance(term, KnownPoints | Waterline):
            parts.append(term.point)
        elif isinstance(term, ScaleBars):
            parts += [term.first, term.second]
    if not parts:
        return None
    mask = torch.zeros(num_points, dtype=torch.bool, device=like.device)
    mask[torch.cat(parts)] = True
    return mask


def _above_plane(state: BundleState, which: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Heights (k) of positions (k, 3) above planes `which` (k), and their derivatives (k, 6) in the position and in the
    tilts and the height of the plane (see `Plane.moved`)."""
    normal, offset = (value[which] for value in state.planes)
    first, second = Plane(normal, offset, check=False).tangents_like(position)
    by_plane = torch.stack((-(second * position).sum(-1), (first * position).sum(-1), -torch.ones_like(offset)), dim=-1)
    return (normal * position).sum(-1) - offset, torch.cat((normal, by_plane), dim=1)


def _scalar(value: Tensor, jacobian: Tensor, columns: Tensor, sigma: Tensor) -> Residuals:
    return Residuals((value / sigma)[:, None], (jacobian / sigma[:, None])[:, None], columns)


def _weighed(error: Tensor, information: Tensor, columns: Tensor) -> Residuals:
    """Of errors (k, 3) with inverse covariances W^T W = information (k, 3, 3)."""
    root = torch.linalg.cholesky_ex(information)[0].mT
    return Residuals((root @ error[..., None])[..., 0], root, columns)


def _all_or(image: Tensor | None, like: Tensor) -> Tensor:
    return torch.arange(len(like), device=like.device) if image is None else image
