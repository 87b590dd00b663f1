"""Three photographs of a painted bed, made by casting rays onto it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Cameras, Capture, Interfaces, Observations, Scene

SIZE = (240, 200)
BED = -2.0
NAMES = ("a.png", "b.png", "c.png")
DOWN = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)


def paint(points):
    """RGB (n, 3) of a bed at x, y: smooth, so that sampling costs little."""
    x, y = points[:, 0], points[:, 1]
    waves = torch.stack(((0.9 * x).sin(), (0.7 * y).cos(), (0.5 * (x + y)).sin()), dim=-1)
    return 120.0 + 60.0 * waves


@pytest.fixture
def flight(tmp_path):
    """`flight(exposures)`: three photographs from 8 m above the water, each as much brighter, and their scene."""

    def make(exposures):
        intrinsics = Intrinsics.create(*SIZE, 150.0)
        center = torch.tensor([[-2.0, 0.0, 8.0], [0.0, 0.5, 8.0], [2.0, -0.5, 8.0]], dtype=torch.float64)
        scene = Scene.create(
            Rigid(DOWN.expand(3, 3, 3).contiguous(), center), intrinsics, Interfaces.level(1.333),
            torch.zeros(0, 3, dtype=torch.float64), Observations.none(), names=NAMES, length_unit="m",
        )  # fmt: skip
        column, row = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="xy")
        pixels = torch.stack((column, row), dim=-1).reshape(-1, 2).double() + 0.5
        for view, exposure in enumerate(exposures):
            origins, directions, _ = scene.camera_of(view).cast_rays(pixels)
            met = origins + ((BED - origins[:, 2]) / directions[:, 2])[:, None] * directions
            picture = (exposure * paint(met)).round().clamp(0, 255).to(torch.uint8).view(SIZE[1], SIZE[0], 3)
            cv2.imwrite(str(tmp_path / NAMES[view]), np.ascontiguousarray(picture.numpy()[..., ::-1]))
        unknown = torch.full((3,), torch.inf, dtype=torch.float64)
        capture = Capture(
            tmp_path, NAMES, tuple(tmp_path / name for name in NAMES), Cameras.of([intrinsics]),
            Interfaces.level(1.333), torch.tensor([[0.0, 0.0, 1.0]] * 3, dtype=torch.float64), unknown,
            torch.ones(3, dtype=torch.float64), torch.zeros(3, dtype=torch.bool), "m",
        )  # fmt: skip
        return replace(scene, capture=capture)

    return make
