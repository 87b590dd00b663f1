"""Random pose problems with truth: the geometries that the solvers are measured on.

tank: points within +-100 cm, 40 to 100 cm deep; cameras on a circle of radius 60 cm at heights 30 and 40 cm, 23 to 40
degrees apart, looking at (0, 0, -70); focal length 667 px. drone: points within +-6 m, 0.5 to 2 m deep; cameras at
(0, 0, 8) and (2.5, 0.3, 8.3) m looking down within 5 degrees; focal length 1500 px. aquarium, whose wall is z = 0:
points within +-40 cm, 10 to 60 cm behind it; cameras 30 to 60 cm before it and 20 to 40 cm apart, looking at (0, 0,
-30) within 5 cm; focal length 1000 px.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

import torchrefrac as tr
from torchrefrac.geometry import heading_rotation, level_rotation, rotate, so3_exp
from torchrefrac.minimal import Layers
from torchrefrac.refinement import OneView, TwoViews, tilt_and_heading
from torchrefrac.refraction.interface import GLASS

Geometry = Literal["tank", "drone", "aquarium"]
GEOMETRIES: tuple[Geometry, ...] = ("tank", "drone")
PIXEL_SIGMA = 0.5
POSITION_LIMIT = {"tank": 0.02, "drone": 0.05}
HEADING_LIMIT_DEG = 0.2


@dataclass(frozen=True)
class Problem:
    """Cameras rotation (2, 3, 3), center (2, 3) and points (N, 3) of the truth; pixels (2, N, 2) with noise, of which
    the second one is random where not `right` (N); down_in_cam (2, 3) as measured."""

    rotation: Tensor
    center: Tensor
    points: Tensor
    pixels: Tensor
    right: Tensor
    down_in_cam: Tensor
    focal: float
    index_ratio: float
    gravity_sigma: float
    layers: Layers | None = None

    @property
    def plane(self) -> Tensor:
        return self.pixels / self.focal

    @property
    def baseline(self) -> float:
        return float((self.center[1] - self.center[0]).norm())

    def two_views(self) -> TwoViews:
        return TwoViews(
            *self.plane,
            cam_from_level=level_rotation(self.down_in_cam),
            focal=torch.full((2,), self.focal, dtype=torch.float64),
            index_ratio=torch.tensor(self.index_ratio, dtype=torch.float64),
            height=float(self.center[0, 2]),
            gravity_sigma=self.gravity_sigma,
            pixel_sigma=PIXEL_SIGMA,
        )

    def one_view(self) -> OneView:
        """The second camera and the true points."""
        return OneView(
            self.plane[1],
            self.points,
            cam_from_level=level_rotation(self.down_in_cam[1]),
            focal=torch.full((2,), self.focal, dtype=torch.float64),
            index_ratio=torch.tensor(self.index_ratio, dtype=torch.float64),
            gravity_sigma=self.gravity_sigma,
            pixel_sigma=PIXEL_SIGMA,
        )

    def true_model(self) -> Tensor:
        """The row (8) of `TwoViews` that is the truth."""
        tilt, heading = tilt_and_heading(level_rotation(self.down_in_cam), self.rotation)
        offset = self.center[1] - self.center[0] * self.center.new_tensor((1.0, 1.0, 0.0))
        center = rotate(heading_rotation(heading[0]), offset)
        return torch.cat((tilt.flatten(), (heading[1] - heading[0])[None], center))

    def relative_errors(self, model: Tensor) -> tuple[float, float]:
        """Position as a part of the baseline, and heading in degrees."""
        truth = self.true_model()
        turned = math.remainder(float(model[4] - truth[4]), 2.0 * math.pi)
        return float((model[5:] - truth[5:]).norm()) / self.baseline, math.degrees(abs(turned))


def make_problem(
    geometry: Geometry,
    points: int,
    generator: torch.Generator,
    *,
    noise: float = PIXEL_SIGMA,
    outliers: float = 0.0,
    gravity_error_deg: float = 0.0,
    index_ratio: float = 1.33,
    glass: float = 0.0,
) -> Problem:
    """Noise in pixels; a part `outliers` of the second pixels is spread evenly over the rectangle that the true ones
    fill; verticals are off by gravity_error_deg in a random direction; glass: thickness of a wall before the water."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    if geometry == "tank":
        start, apart = uniform(-math.pi, math.pi), torch.deg2rad(uniform(23.0, 40.0))
        angle = torch.stack((start, start + apart))
        center = torch.stack((60.0 * angle.cos(), 60.0 * angle.sin(), angle.new_tensor((30.0, 40.0))), dim=-1)
        aim, roll, focal = center.new_tensor((0.0, 0.0, -70.0)).expand(2, 3), torch.zeros(2, dtype=torch.float64), 667.0
        scene = uniform(-100.0, 100.0, points, 2), uniform(-100.0, -40.0, points, 1)
    elif geometry == "aquarium":
        turn, apart, height = uniform(-math.pi, math.pi), 0.5 * uniform(20.0, 40.0), uniform(30.0, 60.0, 2)
        along = apart * torch.stack((turn.cos(), turn.sin()))
        center = torch.cat((torch.stack((along, -along)), height[:, None]), dim=-1)
        aim = torch.cat((uniform(-5.0, 5.0, 2, 2), torch.full((2, 1), -30.0, dtype=torch.float64)), dim=-1)
        roll, focal = uniform(-math.pi, math.pi, 2), 1000.0
        scene = uniform(-40.0, 40.0, points, 2), uniform(-60.0, -10.0, points, 1)
    else:
        center = torch.tensor(((0.0, 0.0, 8.0), (2.5, 0.3, 8.3)), dtype=torch.float64)
        tilt, azimuth = torch.deg2rad(uniform(0.0, 5.0, 2)), uniform(-math.pi, math.pi, 2)
        ahead = torch.stack((tilt.sin() * azimuth.cos(), tilt.sin() * azimuth.sin(), -tilt.cos()), dim=-1)
        aim, roll, focal = center + ahead, uniform(-math.pi, math.pi, 2), 1500.0
        scene = uniform(-6.0, 6.0, points, 2), uniform(-2.0, -0.5, points, 1)
    world = torch.cat(scene, dim=-1)
    rotation = looking_at(center, aim, roll)
    interface = tr.FlatInterface(index_ratio)
    layers = None
    if glass:
        interface = tr.FlatInterface(layers=(1.0, GLASS, index_ratio), thickness=(glass,))
        layers = Layers(*torch.tensor(((GLASS,), (glass,)), dtype=torch.float64))
    lens = tr.Intrinsics.create(2, 2, focal, principal_point=(0.0, 0.0))
    seen, _ = tr.RefractiveCamera(lens, rotation, center, interface)[:, None].project(world)
    pixels = seen + noise * normal(2, points, 2)
    right = torch.arange(points) >= round(outliers * points)
    low, high = pixels[1].amin(dim=0), pixels[1].amax(dim=0)
    pixels[1] = torch.where(right[:, None], pixels[1], low + (high - low) * uniform(0.0, 1.0, points, 2))
    down = -rotation[..., 2]
    sideways = torch.nn.functional.normalize(torch.linalg.cross(down, normal(2, 3)), dim=-1)
    measured = rotate(so3_exp(math.radians(gravity_error_deg) * sideways), down)
    sigma = math.radians(gravity_error_deg) / math.sqrt(2.0)
    return Problem(rotation, center, world, pixels, right, measured, focal, index_ratio, sigma, layers)


def looking_at(center: Tensor, aim: Tensor, roll: Tensor) -> Tensor:
    """cam_from_world rotations (*B, 3, 3) of cameras that look from `center` to `aim`, rolled about their axis."""
    forward = torch.nn.functional.normalize(aim - center, dim=-1)
    north = forward.new_tensor((0.0, 1.0, 0.0)).expand_as(forward)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, north), dim=-1)
    down = torch.linalg.cross(forward, right)
    c, s = roll.cos()[..., None], roll.sin()[..., None]
    return torch.stack((c * right + s * down, c * down - s * right, forward), dim=-2)
