"""Planted alignments: cameras above a basin of water, what they see, and what a pinhole would have made of it."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.files.water import Water
from torchrefrac.geometry import Plane, align_above_plane, so3_exp
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Alignment


@dataclass(frozen=True)
class PlantedAlignment:
    """The true alignment and the true water."""

    truth: Alignment
    water: Water

    def as_of_a_pinhole(self, draw, size: float = 1.0) -> Alignment:
        """Cameras turned by a degree and moved by 2 % of their height, points three quarters as deep, times size."""
        given, m = self.truth, len(self.truth)
        shift = 0.02 * size * given.center[:, 2:] * draw.directions(m)
        return replace(
            given,
            rotation=so3_exp(torch.deg2rad(size * draw.directions(m))) @ given.rotation,
            center=given.center + shift,
            points=given.points * given.points.new_tensor((1.0, 1.0, 1.0 - 0.25 * size)),
        )

    def off(self, alignment: Alignment) -> Tensor:
        """How far the cameras (m) are from the true ones after aligning x, y, heading and scale."""
        truth = self.truth.center[[self.truth.names.index(name) for name in alignment.names]]
        return (align_above_plane(alignment.center, truth).apply(alignment.center) - truth).norm(dim=-1)


def plant_alignment(basin, draw, noise=0.0, lenses=1, planes=1) -> PlantedAlignment:
    """All observations in the images of `basin`, with noise in pixels; lenses and planes in turn, each a little
    different from the one before."""
    m = len(basin.center)
    turn = torch.arange(m)
    given = tuple(
        replace(basin.lens, width=1024 + 16 * i, focal=basin.lens.focal * (1.0 + 0.06 * i)) for i in range(lenses)
    )
    step = torch.arange(planes, dtype=torch.float64)
    normal = torch.nn.functional.normalize(torch.stack((0.02 * step, -0.03 * step, torch.ones_like(step)), -1), dim=-1)
    names = tuple(f"cam{i:02d}.jpg" for i in range(m))
    plane_of = {name: i % planes for i, name in enumerate(names)} if planes > 1 else {}
    water = Water(basin.index_ratio, normal, 2.0 * step, plane_of)
    point, image = basin.project()[1].T.nonzero(as_tuple=True)
    interface = FlatInterface(basin.index_ratio, plane=Plane(normal[turn % planes], water.offset[turn % planes]))
    focal = torch.stack([lens.focal for lens in given])[turn % lenses]
    cameras = RefractiveCamera(replace(basin.lens, focal=focal), basin.rotation, basin.center, interface)
    pixels, valid = cameras[image].project(basin.points[point])
    assert valid.all()
    truth = Alignment(
        names=names,
        lenses=given,
        lens=turn % lenses,
        rotation=basin.rotation,
        center=basin.center,
        points=basin.points,
        colors=torch.randint(256, (len(basin.points), 3), dtype=torch.uint8, generator=draw.generator),
        image=image,
        point=point,
        pixels=pixels + noise * draw.normal(len(image), 2),
    )
    return PlantedAlignment(truth, water)
