"""What rays see through water: against a tracer in NumPy that follows them one by one."""

import math

import numpy as np
import pytest
import torch

from tests.synthetic.tracer import meets
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry.surfaces import Rectangle
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic.sight import Scenery, see
from torchrefrac.synthetic.stage import Piece


def trace(surfaces, center, way, index_ratio, half=math.inf):
    """Where one ray ends, and on which surface; None and -1 where on none. half: of the side of a square of water."""
    to_water = center[2] / -way[2] if way[2] < 0 else math.inf
    if to_water < math.inf and np.abs(center + to_water * way)[:2].max() > half:
        to_water = math.inf
    dry = [meets(surface, center, way)[0] for surface in surfaces]
    if min(dry) < to_water:
        return center + min(dry) * way, int(np.argmin(dry))
    if to_water == math.inf:
        return None, -1
    entry = center + to_water * way
    sine = np.hypot(way[0], way[1])
    bent = np.array((*way[:2] / index_ratio, -math.sqrt(1.0 - (sine / index_ratio) ** 2)))
    wet = [meets(surface, entry, bent)[0] for surface in surfaces]
    return (None, -1) if min(wet) == math.inf else (entry + min(wet) * bent, int(np.argmin(wet)))


def camera_of(stage, image, index_ratio):
    lens = Intrinsics.create(400, 300, 300.0)
    return RefractiveCamera(lens, stage.rotation[image], stage.center[image], FlatInterface(index_ratio))


@pytest.mark.parametrize("index_ratio", [1.0, 1.333, 1.5])
def test_points_are_those_of_a_tracer_that_follows_rays_one_by_one(stage, draw, index_ratio):
    camera = camera_of(stage, 1, index_ratio)
    pixels = draw.uniform(0.0, 1.0, 400, 2) * torch.tensor((400.0, 300.0))

    sight = see(stage.pieces, camera, pixels)

    surfaces = [piece.surface for piece in stage.pieces]
    in_cam = np.concatenate(((pixels.numpy() - (200.0, 150.0)) / 300.0, np.ones((400, 1))), axis=-1)
    ways = in_cam @ stage.rotation[1].numpy()
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    traced = [trace(surfaces, stage.center[1].numpy(), way, index_ratio) for way in ways]
    assert sight.piece.tolist() == [piece for _, piece in traced]
    assert set(sight.piece.tolist()) >= {0, 1, 2, 3}
    points = np.array([point if point is not None else (np.nan,) * 3 for point, _ in traced])
    np.testing.assert_allclose(sight.points.numpy(), points, rtol=0.0, atol=1e-9)


def test_rays_beyond_the_extent_of_the_water_go_straight_on(stage, draw):
    camera = camera_of(stage, 1, 1.333)
    pixels = draw.uniform(0.0, 1.0, 400, 2) * torch.tensor((400.0, 300.0))
    ways = camera.view_directions(pixels)
    half = 0.999 * float(
        (stage.center[1, :2] + stage.center[1, 2] / -ways[:, 2:] * ways[:, :2]).abs().amax(dim=-1).median()
    )
    square = ((-half, -half), (half, -half), (half, half), (-half, half))

    sight = Scenery(stage.pieces, 1.333, extent=square).look(stage.center[1], ways)

    surfaces = [piece.surface for piece in stage.pieces]
    traced = [trace(surfaces, stage.center[1].numpy(), way, 1.333, half) for way in ways.numpy()]
    assert sight.piece.tolist() == [piece for _, piece in traced]
    points = np.array([point if point is not None else (np.nan,) * 3 for point, _ in traced])
    np.testing.assert_allclose(sight.points.numpy(), points, rtol=0.0, atol=1e-9)
    straight_below = ~sight.in_water & (sight.points[:, 2] < 0.0)
    assert int(straight_below.sum()) > 20
    assert int(sight.in_water.sum()) > 20


def test_points_project_back_to_their_pixels_above_and_below_the_water(stage, draw):
    camera = camera_of(stage, 0, 1.333)
    pixels = draw.uniform(0.0, 1.0, 2000, 2) * torch.tensor((400.0, 300.0))

    sight = see(stage.pieces, camera, pixels)

    met = sight.piece >= 0
    projected, valid = camera.project(sight.points[met])
    assert bool(valid.all())
    assert torch.allclose(projected, pixels[met], atol=1e-8)
    above = sight.points[met][:, 2] > 0.0
    assert int(above.sum()) > 20
    assert torch.equal(above, ~sight.in_water[met])


def test_a_ray_that_goes_upwards_meets_what_stands_in_its_way_and_never_the_water(floor):
    wall = Piece("wall", Rectangle(floor.surface.corner + 40.0, *(floor.surface.edge2, torch.eye(3).double()[2] * 200)),
                 floor.texture)  # fmt: skip
    level = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    center = torch.tensor((-80.0, 0.0, 10.0), dtype=torch.float64)
    camera = RefractiveCamera(Intrinsics.create(40, 40, 20.0), level, center, FlatInterface(1.333))
    pixels = torch.tensor(((20.0, 10.0), (20.0, 20.0), (20.0, 30.0)), dtype=torch.float64)

    sight = see((floor, wall), camera, pixels)

    assert sight.piece.tolist() == [1, 1, 0]
    assert sight.in_water.tolist() == [False, False, True]


def test_pieces_under_water_are_not_asked_about_dry_rays(stage, floor):
    class Counted:
        asked = 0

        def intersect(self, origins, directions):
            self.asked += 1
            return floor.surface.intersect(origins, directions)

        def triangles(self):
            return floor.surface.triangles()

    counted = Counted()

    see((Piece("floor", counted, floor.texture),), camera_of(stage, 0, 1.333), torch.full((5, 2), 100.0).double())

    assert counted.asked == 1
