"""A small scene over and under water, photographed at once."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.geometry.surfaces import Cylinder, Rectangle
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.synthetic.options import CameraOptions, SensorOptions, SyntheticOptions
from torchrefrac.synthetic.paths import look_at, ring
from torchrefrac.synthetic.stage import Piece, Stage


def vector(*components):
    return torch.tensor(components, dtype=torch.float64)


def stripes(uv):
    """Colours that tell the place: the red grows with u, the green with v, the blue is striped."""
    u, v = uv.float().unbind(dim=-1)
    return torch.stack((40.0 + 150.0 * u, 40.0 + 150.0 * v, 128.0 + 60.0 * (40.0 * (u + v)).sin()), dim=-1)


@pytest.fixture
def floor():
    return Piece("floor", Rectangle(vector(-90, -90, -50), vector(180, 0, 0), vector(0, 180, 0)), stripes, True)


@pytest.fixture
def pieces(floor):
    """A floor, a board, a pillar that rises out of the water, and a roof of two triangles under water."""
    board = Rectangle(vector(-20, -15, -45), vector(30, 0, 10), vector(0, 25, 3))
    pillar = Cylinder(vector(15, 10, -50), vector(3, -2, 65), 5.0)
    corners = torch.stack((vector(0, -30, -20), vector(25, -30, -20), vector(25, -10, -30), vector(0, -10, -12)))
    roof = TriangleMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    return (
        floor,
        Piece("board", board, stripes, True),
        Piece("pillar", pillar, stripes),
        Piece("roof", roof, stripes),
    )


@pytest.fixture
def stage(pieces):
    """Three cameras around the pieces."""
    center = ring(3, 40.0, (30.0, 42.0), (0.0, 360.0))
    rotation = look_at(center, vector(0, 0, -35).expand_as(center), vector(0.1, -0.2, 0.4))
    return Stage(pieces, rotation, center, "cm", ambient=0.4, direct=0.6, position_sigma=2.0)


@pytest.fixture
def options():
    """Small photographs through a lens with distortion."""
    camera = CameraOptions(width=48, height=36, fov_deg=60.0, distortion=(-0.1, 0.02, 1e-3, -5e-4, 0.0))
    return SyntheticOptions(name="pond", camera=camera, sensor=SensorOptions(samples=2), seed=7)


@pytest.fixture
def calm(options):
    """Without any error of the sensor: one ray a pixel, neither blur nor noise."""
    return replace(options, sensor=SensorOptions(samples=1, blur=0.0, noise=0.0))
