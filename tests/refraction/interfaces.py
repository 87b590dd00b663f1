"""Interfaces of every kind, upright and tilted, and sightings through them."""

import pytest
import torch
from torch import Tensor

from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface

TILTED = Plane((0.3, -0.2, 1.0), 0.4)
WALL = Plane((-1.0, 0.1, 0.0), -0.3)
BELOW = Plane((0.0, 0.0, -1.0), 2.0)

INTERFACES = {
    "water": FlatInterface(1.333),
    "tilted water": FlatInterface(1.333, plane=TILTED),
    "glass wall": FlatInterface.glass_wall(WALL, 0.1),
    "port": FlatInterface.flat_port(0.05, 0.1),
    "slab": FlatInterface.slab(TILTED, 0.3),
    "looking out": FlatInterface(layers=(1.333, 1.0), plane=BELOW),
    "looking out through glass": FlatInterface(layers=(1.333, 1.52, 1.0), thickness=(0.2,), plane=WALL),
    "air gap": FlatInterface(layers=(1.333, 1.0, 1.333), thickness=(0.3,), plane=TILTED),
    "oil on water in a glass": FlatInterface(
        layers=(1.0, 1.47, 1.333, 1.52, 1.1), thickness=(0.1, 0.2, 0.1), plane=TILTED
    ),
    "denser and denser": FlatInterface(layers=(1.1, 1.3, 1.7, 2.4), thickness=(0.2, 0.2)),
    "rarer and rarer": FlatInterface(layers=(2.4, 1.7, 1.3, 1.1), thickness=(0.2, 0.2), plane=TILTED),
}

through_every_interface = pytest.mark.parametrize("interface", INTERFACES.values(), ids=INTERFACES.keys())


def depth_of_borders(interface: FlatInterface) -> Tensor:
    """How far each surface lies behind the first, (number of surfaces)."""
    return torch.tensor((0.0, *interface.thickness), dtype=torch.float64).cumsum(dim=0)


def at_depth(draw, interface: FlatInterface, depth: Tensor, lateral=1.0) -> Tensor:
    """Points (n, 3) at `depth` (n) behind the first surface, each up to `lateral` to the side in either direction."""
    first, second = interface.plane.tangents_like(depth)
    normal, side = interface.plane.normal_like(depth), draw.uniform(-lateral, lateral, len(depth), 2)
    return (interface.plane.offset - depth)[:, None] * normal + side[:, :1] * first + side[:, 1:] * second


def cameras_before(draw, interface: FlatInterface, count: int, lateral=1.0) -> Tensor:
    """Centres (count, 3) within 0.5 to 2 of the first surface."""
    return at_depth(draw, interface, -draw.uniform(0.5, 2.0, count), lateral)


def points_behind(draw, interface: FlatInterface, count: int) -> Tensor:
    """Points (count, 3) within 0.2 to 2 of the last surface, in the last medium."""
    return at_depth(draw, interface, depth_of_borders(interface)[-1] + draw.uniform(0.2, 2.0, count))


def points_within(draw, interface: FlatInterface, count: int) -> Tensor:
    """Points (count, 3) in any layer but the camera's."""
    return at_depth(draw, interface, draw.uniform(0.02, 1.0, count))
