"""Points that a view may show, against a look at each."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces, Observations, Scene
from torchrefrac.sfm.in_sight import Clusters
from torchrefrac.synthetic.paths import look_at

POINTS = 20_000
SURFACES = {
    "water": Interfaces.level(1.333),
    "air": Interfaces.level(1.0),
    "glass": replace(
        Interfaces.level(1.333),
        layers=torch.tensor([[1.52]], dtype=torch.float64),
        thickness=torch.tensor([[0.5]], dtype=torch.float64),
    ),
}


@pytest.fixture
def scene_of(draw):
    """`scene_of(interfaces, distortion)`: views that look down and aside at points in the water and above it."""

    def make(interfaces, distortion=0.0) -> Scene:
        lens = Intrinsics.create(1024, 768, 667.0, distortion=(distortion, 0.0, 0.0, 0.0, 0.0))
        center = torch.cat((draw.uniform(-30.0, 30.0, 6, 2), draw.uniform(30.0, 60.0, 6, 1)), dim=-1)
        aim = torch.cat((draw.uniform(-30.0, 30.0, 6, 2), torch.full((6, 1), -3.0).double()), dim=-1)
        points = torch.cat((draw.uniform(-150.0, 150.0, POINTS, 2), draw.uniform(-6.0, 1.0, POINTS, 1)), dim=-1)
        pose = Rigid(look_at(center, aim, up=(0.0, 0.0, 1.0)), center)
        return Scene.create(pose, lens, interfaces, points, Observations.none())

    return make


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("distortion", [0.0, 0.1], ids=["ideal", "distorted"])
def test_all_that_lie_in_the_image_are_among_them_and_few_others(scene_of, surface, distortion):
    scene = scene_of(SURFACES[surface], distortion)
    clusters = Clusters.of(scene)

    for view in range(len(scene.views)):
        every = torch.arange(len(scene.points))
        _, inside = scene.camera_of(torch.full_like(every, view), every).project(scene.points, inside_image=True)
        may = clusters.before(view)
        assert bool(may[inside].all())
        assert int(may.sum()) < int(inside.sum()) + 0.6 * POINTS


def test_points_without_a_place_are_not_among_them(scene_of):
    scene = replace(scene_of(SURFACES["water"]), placed=torch.arange(POINTS) % 3 == 0)

    assert not bool((Clusters.of(scene).before(0) & ~scene.placed).any())


def test_where_points_are_dry_these_are_all_that_are_placed(scene_of):
    scene = scene_of(SURFACES["water"])
    scene = replace(scene, dry=torch.arange(POINTS) < 5)

    assert bool(Clusters.of(scene).before(0).all())
