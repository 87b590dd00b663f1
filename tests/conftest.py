"""Fixtures of the whole suite: seeded random numbers and the data sets that lie beside the repository."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


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


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data("tank")` is the folder of that data set; a checkout that lies without them skips the test."""

    def folder(name: str) -> Path:
        path = SHARED_DATA / name
        if not path.is_dir():
            pytest.skip(f"the data set {name!r} does not lie beside the repository, in ../shared/data")
        return path

    return folder
