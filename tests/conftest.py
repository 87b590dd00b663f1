"""Fixtures of the whole suite: seeded random numbers, a scene, and the data sets that lie beside the repository."""

import gc
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import heading_rotation, level_rotation, rotate, split_heading
from torchrefrac.refraction import FlatInterface, lift_points
from torchrefrac.refraction.interface import GLASS


def pytest_collection_finish() -> None:
    """What is loaded by now stays to the end: looking for garbage in it takes an eighth of the time of the tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SHARED_CASES = SHARED_DATA.with_name("cases")


@dataclass(frozen=True)
class Draw:
    """Random float64 tensors, the same ones in every run."""

    generator: torch.Generator

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=self.generator, dtype=torch.float64)

    def power_of_ten(self, low: float, high: float, *shape: int) -> Tensor:
        """10^x with x uniform in [low, high]."""
        return 10.0 ** self.uniform(low, high, *shape)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def directions(self, *shape: int) -> Tensor:
        """Unit vectors (*shape, 3), uniform on the sphere."""
        return torch.nn.functional.normalize(self.normal(*shape, 3), dim=-1)

    def rotations(self, *shape: int) -> Tensor:
        """Rotation matrices (*shape, 3, 3), made by QR rather than by the package."""
        q = torch.linalg.qr(self.normal(*shape, 3, 3)).Q
        return q * torch.linalg.det(q)[..., None, None]


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(20111106)


@pytest.fixture
def draw(generator: torch.Generator) -> Draw:
    return Draw(generator)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """`made_once(name, make)` is a folder that `make(folder)` fills: once in a session, also where several workers
    share it. Tests read it and change nothing in it."""
    own = tmp_path_factory.getbasetemp()
    common = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def once(name: str, make: Callable[[Path], None]) -> Path:
        folder, finished = common / name, common / f"{name}.finished"
        with FileLock(common / f"{name}.lock"):
            if not finished.exists():
                folder.mkdir()
                make(folder)
                finished.touch()
        return folder

    return once


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data("tank")` is the folder of that data set; a checkout that lies without them skips the test."""

    def folder(name: str) -> Path:
        path = SHARED_DATA / name
        if not path.is_dir():
            pytest.skip(f"the data set {name!r} does not lie beside the repository, in ../shared/data")
        return path

    return folder


@pytest.fixture
def shared_case() -> Callable[[str], Path]:
    """`shared_case("08-alpha")` is the folder of that case; a checkout that lies without them skips the test."""

    def folder(name: str) -> Path:
        path = SHARED_CASES / name
        if not path.is_dir():
            pytest.skip(f"the case {name!r} does not lie beside the repository, in ../shared/cases")
        return path

    return folder


@dataclass(frozen=True)
class Basin:
    """Cameras around a basin of water and points in it, in centimetres: a truth to take measurements from.

    rotation (*B, m, 3, 3) cam_from_world, center (*B, m, 3), points (*B, n, 3). glass: thickness of a pane that lies on
    the water, its dry face at z = 0.
    """

    lens: Intrinsics
    index_ratio: float
    rotation: Tensor
    center: Tensor
    points: Tensor
    glass: float = 0.0

    @property
    def interface(self) -> FlatInterface:
        if not self.glass:
            return FlatInterface(self.index_ratio)
        return FlatInterface(layers=(1.0, GLASS, self.index_ratio), thickness=(self.glass,))

    @property
    def cameras(self) -> RefractiveCamera:
        """(*B, m)."""
        return RefractiveCamera(self.lens, self.rotation, self.center, self.interface)

    @property
    def down_in_cam(self) -> Tensor:
        return -self.rotation[..., 2]

    @property
    def heading(self) -> Tensor:
        return split_heading(self.rotation)[1]

    def project(self) -> tuple[Tensor, Tensor]:
        """Pixels (*B, m, n, 2), and which lie inside the image (*B, m, n)."""
        cameras = RefractiveCamera(self.lens, self.rotation[..., None, :, :], self.center[..., None, :], self.interface)
        pixels, valid = cameras.project(self.points[..., None, :, :])
        return pixels, valid & self.lens.contains(pixels)

    def level_rays(self) -> Tensor:
        """Gravity-aligned rays (*B, m, n, 3), straight from the lifted points: no lens and no gravity take part."""
        offset, _ = lift_points(self.center[..., None, :], self.points[..., None, :, :], self.interface)
        return offset @ heading_rotation(self.heading).mT

    def level_rays_of(self, pixels: Tensor) -> Tensor:
        """Gravity-aligned rays (*B, m, n, 3) of pixels (*B, m, n, 2)."""
        plane = self.lens.plane_from_pixels(pixels)
        return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ level_rotation(self.down_in_cam)

    def second_from_first(self) -> tuple[Tensor, Tensor]:
        """Heading (*B) and centre (*B, 3) of the second camera where the first stands at x = y = 0 with heading 0."""
        first = self.heading[..., 0]
        center = self.center[..., 1, :] - self.center[..., 0, :] * self.center.new_tensor((1.0, 1.0, 0.0))
        return self.heading[..., 1] - first, rotate(heading_rotation(first), center)


@pytest.fixture
def make_basin(draw: Draw) -> Callable[..., Basin]:
    """`make_basin(*shape, cameras=2, points=7)`: cameras `heights` above the water in turn, 23 to 40 degrees apart on
    a circle of radius 60, with 75 degrees of view (1024 x 768 pixels) over its middle; points within +-100 and 40 to
    100 deep, the first `land` of them 0 to 15 above the water instead. Each is in the image of at least `seen_by`
    cameras (default: all).
    """

    def make(
        *shape: int,
        cameras: int = 2,
        points: int = 7,
        land: int = 0,
        index_ratio: float = 1.33,
        distortion: tuple[float, ...] = (0.0,) * 5,
        seen_by: int | None = None,
        heights: tuple[float, float] = (30.0, 40.0),
        glass: float = 0.0,
    ) -> Basin:
        angle = torch.cumsum(torch.deg2rad(draw.uniform(23.0, 40.0, *shape, cameras)), dim=-1)
        height = torch.tensor(heights, dtype=torch.float64).repeat(cameras)[:cameras].expand_as(angle)
        center = torch.stack((60.0 * angle.cos(), 60.0 * angle.sin(), height), dim=-1)
        aim = torch.cat(
            (draw.uniform(-15.0, 15.0, *shape, cameras, 2), draw.uniform(-85.0, -65.0, *shape, cameras, 1)), dim=-1
        )
        rotation = _looking_at(center, aim, torch.deg2rad(draw.uniform(-20.0, 20.0, *shape, cameras)))
        lens = Intrinsics.create(1024, 768, 667.0, distortion=distortion)
        empty = Basin(lens, index_ratio, rotation, center, center.new_zeros(*shape, 0, 3), glass)
        wanted = cameras if seen_by is None else seen_by
        dry = _seen(draw, empty, land, wanted, reach=60.0, low=0.0, high=15.0)
        wet = _seen(draw, empty, points - land, wanted, reach=100.0, low=-100.0, high=-40.0)
        return replace(empty, points=torch.cat((dry, wet), dim=-2))

    return make


def _looking_at(center: Tensor, aim: Tensor, roll: Tensor) -> Tensor:
    """cam_from_world rotations (*B, 3, 3) of cameras that look from `center` to `aim`."""
    forward = torch.nn.functional.normalize(aim - center, dim=-1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, forward.new_tensor((0.0, 0.0, 1.0)).expand_as(forward)), dim=-1
    )
    down = torch.linalg.cross(forward, right)
    c, s = roll.cos()[..., None], roll.sin()[..., None]
    return torch.stack((c * right + s * down, c * down - s * right, forward), dim=-2)


def _seen(draw: Draw, basin: Basin, count: int, wanted: int, reach: float, low: float, high: float) -> Tensor:
    """Points (*B, count, 3), the first that `wanted` cameras see among many that are spread evenly."""
    shape = basin.center.shape[:-2]
    many = (8 if high < 0.0 else 30) * count + 100
    points = torch.cat((draw.uniform(-reach, reach, *shape, many, 2), draw.uniform(low, high, *shape, many, 1)), dim=-1)
    seen = replace(basin, points=points).project()[1].sum(dim=-2) >= wanted
    assert (seen.sum(dim=-1) >= count).all()
    first = (~seen).to(torch.int8).argsort(dim=-1, stable=True)[..., :count]
    return points.gather(-2, first[..., None].expand(*first.shape, 3))
