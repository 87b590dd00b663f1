"""Planted reconstructions: cameras above a basin of water, what they see, and what a pinhole would have made of it."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane, Rigid, align_above_plane, so3_exp
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Interfaces, Observations, Scene


@dataclass(frozen=True)
class PlantedReconstruction:
    """The true scene."""

    truth: Scene

    def as_of_a_pinhole(self, draw, size: float = 1.0) -> Scene:
        """Cameras turned by a degree and moved by 2 % of their height, points three quarters as deep, times size."""
        given, m = self.truth, len(self.truth.views)
        shift = 0.02 * size * given.views.center[:, 2:] * draw.directions(m)
        rotation = so3_exp(torch.deg2rad(size * draw.directions(m))) @ given.views.rotation
        return replace(
            given,
            views=given.views.at(rotation, given.views.center + shift),
            points=given.points * given.points.new_tensor((1.0, 1.0, 1.0 - 0.25 * size)),
        )

    def off(self, scene: Scene) -> Tensor:
        """How far the registered cameras (r) are from the true ones after aligning x, y, heading and scale."""
        views, names = scene.views, self.truth.views.names
        truth = self.truth.views.center[[names.index(name) for name in views.names]][views.registered]
        center = views.center[views.registered]
        return (align_above_plane(center, truth).apply(center) - truth).norm(dim=-1)


def plant_reconstruction(basin, draw, noise=0.0, intrinsics=1, interfaces=1) -> PlantedReconstruction:
    """All observations in the images of `basin`, with noise in pixels; so many intrinsics and interfaces in turn, each
    a little different from the one before."""
    m = len(basin.center)
    turn = torch.arange(m)
    given = tuple(
        replace(basin.lens, width=1024 + 16 * i, focal=basin.lens.focal * (1.0 + 0.06 * i)) for i in range(intrinsics)
    )
    step = torch.arange(interfaces, dtype=torch.float64)
    normal = torch.nn.functional.normalize(torch.stack((0.02 * step, -0.03 * step, torch.ones_like(step)), -1), dim=-1)
    offset = 2.0 * step
    point, view = basin.project()[1].T.nonzero(as_tuple=True)
    interface = FlatInterface(basin.index_ratio, plane=Plane(normal[turn % interfaces], offset[turn % interfaces]))
    focal = torch.stack([one.focal for one in given])[turn % intrinsics]
    cameras = RefractiveCamera(replace(basin.lens, focal=focal), basin.rotation, basin.center, interface)
    pixels, valid = cameras[view].project(basin.points[point])
    assert valid.all()
    colors = torch.randint(256, (len(basin.points), 3), dtype=torch.uint8, generator=draw.generator)
    truth = Scene.create(
        Rigid(basin.rotation, basin.center),
        given,
        Interfaces(normal, offset, torch.full_like(offset, basin.index_ratio)),
        basin.points,
        Observations(view, point, pixels + noise * draw.normal(len(view), 2)),
        names=tuple(f"cam{i:02d}.jpg" for i in range(m)),
        camera=turn % intrinsics,
        interface=turn % interfaces,
        colors=colors,
    )
    return PlantedReconstruction(truth)
