"""The wall or port of glass that photographs are taken through: for the renderer, and as capture.json has it."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import Plane, so3_exp
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic.options import SyntheticOptions


def glass_of(options: SyntheticOptions) -> FlatInterface | None:
    """Air, glass and water, in the world of a wall or in the frame of a port's camera; None: a water surface."""
    interface = options.interface
    if options.at_surface:
        return None
    is_port = interface.kind == "port"
    return FlatInterface(
        layers=(1.0, interface.glass_index, options.index_ratio),
        thickness=(interface.glass_thickness,),
        plane=Plane(port_normal(options), -interface.distance) if is_port else Plane(),
        moves_with_camera=is_port,
    )


def port_normal(options: SyntheticOptions) -> Float[Tensor, " 3"]:
    """Unit normal of the port towards the camera's side, in the camera's frame."""
    turn = so3_exp(torch.tensor((*options.interface.tilt_deg, 0.0), dtype=torch.float64).deg2rad())
    return turn @ torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64)


def interface_content(options: SyntheticOptions) -> dict[str, Any]:
    """What capture.json and truth.json say of it. A water surface is said by its index ratio alone."""
    interface = options.interface
    if options.at_surface:
        return {"index_ratio": options.index_ratio}
    glass = {"index": interface.glass_index, "thickness": interface.glass_thickness}
    content: dict[str, Any] = {
        "kind": interface.kind,
        "layers": [{"index": 1.0}, glass, {"index": options.index_ratio}],
    }
    if interface.kind == "port":
        content |= {"normal_in_cam": port_normal(options).tolist(), "distance": interface.distance}
    return {"interface": content}
