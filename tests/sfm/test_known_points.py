"""Calibration through water by points whose places are known."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import BundleOptions
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid, so3_exp
from torchrefrac.scene import Cameras, Interfaces, Observations, Scene
from torchrefrac.scene.interfaces import PORT, WALL
from torchrefrac.sfm.known_points import CalibrationError, calibrate_by_points

LENS = Intrinsics.create(1280, 960, 1000.0)
GLASS, WATER = 1.52, 1.333


def _board(columns=9, rows=7, square=3.0):
    x, y = torch.meshgrid(torch.arange(columns).double(), torch.arange(rows).double(), indexing="xy")
    flat = square * torch.stack((x - 0.5 * (columns - 1), y - 0.5 * (rows - 1)), dim=-1).reshape(-1, 2)
    return torch.cat((flat, torch.zeros(len(flat), 1, dtype=torch.float64)), dim=-1)


def _port(tilt_deg=(1.0, -0.5), distance=2.0, thickness=0.8, sigmas=None):
    turn = so3_exp(torch.tensor((*tilt_deg, 0.0), dtype=torch.float64).deg2rad())
    normal = (turn @ torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64))[None]
    one = torch.ones(1, dtype=torch.float64)
    layers = GLASS * one[:, None], thickness * one[:, None]
    return Interfaces(normal, -distance * one, WATER * one, *layers, (PORT,), sigmas or {})


def _around(draw, views, distance, tilt=0.5):
    """Poses of cameras that look at the middle of a board from all sides."""
    turns = so3_exp(tilt * draw.uniform(-1.0, 1.0, views, 3))
    facing = turns @ torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64))
    aside = torch.cat((draw.uniform(-3.0, 3.0, views, 2), distance * draw.uniform(0.8, 1.3, views, 1)), dim=-1)
    center = -(facing.mT @ aside[..., None])[..., 0]
    return Rigid(facing, center)


def _seen(draw, scene, noise):
    """The scene with what its cameras see of its points."""
    m, n = len(scene.views), len(scene.points)
    point, view = (grid.flatten() for grid in torch.meshgrid(torch.arange(n), torch.arange(m), indexing="ij"))
    pixels, valid = scene.camera_of(view).project(scene.points[point], inside_image=True)
    rows = valid.nonzero()[:, 0]
    seen = Observations(view[rows], point[rows], pixels[rows] + noise * draw.normal(len(rows), 2))
    return replace(scene, observations=seen, accepted=torch.ones(len(rows), dtype=torch.bool))


@pytest.fixture
def dive(draw):
    """`dive(noise)`: a housed camera before a board, truly."""

    def make(noise=0.0, views=12):
        pose, points = _around(draw, views, 45.0), _board()
        return _seen(draw, Scene.create(pose, LENS, _port(), points, Observations.none()), noise)

    return make


def test_without_noise_port_and_poses_are_exact(dive):
    truth = dive()
    stated = _port((0.0, 0.0), 2.4, sigmas={"plane_height": 0.5, "plane_tilt": math.radians(2.0)})

    found = calibrate_by_points(replace(truth, interfaces=stated), BundleOptions(pixel_sigma=1e-5))

    torch.testing.assert_close(found.scene.interfaces.offset, truth.interfaces.offset, rtol=0.0, atol=1e-5)
    torch.testing.assert_close(found.scene.interfaces.normal, truth.interfaces.normal, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(found.scene.views.center, truth.views.center, rtol=0.0, atol=1e-5)
    assert found.rms < 1e-5


def test_noise_leaves_errors_as_large_as_is_stated(dive):
    truth = dive(noise=0.3, views=20)
    stated = _port((0.0, 0.0), 2.4, sigmas={"plane_height": 0.5, "plane_tilt": math.radians(2.0)})

    found = calibrate_by_points(replace(truth, interfaces=stated), BundleOptions(pixel_sigma=0.3))

    sigma = found.known.planes[0]
    off = float(found.scene.interfaces.offset - truth.interfaces.offset)
    turned = torch.linalg.cross(found.scene.interfaces.normal, truth.interfaces.normal).norm()
    assert abs(off) < 3.0 * float(sigma[2])
    assert float(turned) < 3.0 * float(sigma[:2].norm())
    assert float(sigma[2]) < 0.5
    assert found.rms == pytest.approx(0.3 * math.sqrt(2.0), rel=0.1)
    assert {each.name for each in found.determined} >= {"plane_height", "plane_tilt", "layer_thickness"}


def test_wrong_corners_are_left_out(dive, draw):
    truth = dive(noise=0.2)
    pixels = truth.observations.pixels.clone()
    pixels[::25] += 12.0
    wrong = replace(truth, observations=replace(truth.observations, pixels=pixels))
    stated = _port((0.0, 0.0), 2.2, sigmas={"plane_height": 0.5, "plane_tilt": math.radians(2.0)})

    found = calibrate_by_points(replace(wrong, interfaces=stated))

    assert not found.scene.accepted[::25].any()
    assert float(found.scene.accepted.double().mean()) > 0.94


def test_a_wall_in_the_frame_of_a_board_is_found_with_its_poses(draw):
    pose = _around(draw, 10, 60.0)
    one = torch.ones(1, dtype=torch.float64)
    layers = GLASS * one[:, None], 1.2 * one[:, None]
    normal = torch.nn.functional.normalize(torch.tensor([[0.03, -0.02, 1.0]], dtype=torch.float64), dim=-1)
    wall = Interfaces(normal, 12.0 * one, WATER * one, *layers, (WALL,))
    truth = _seen(draw, Scene.create(pose, LENS, wall, _board(), Observations.none()), 0.2)
    stated = replace(
        wall,
        normal=torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
        offset=wall.offset + 1.0,
        sigmas={"plane_height": 2.0, "plane_tilt": math.radians(3.0)},
    )

    found = calibrate_by_points(replace(truth, interfaces=stated))

    sigma = found.known.planes[0]
    assert abs(float(found.scene.interfaces.offset - wall.offset)) < 3.0 * float(sigma[2])
    assert float(torch.linalg.cross(found.scene.interfaces.normal, normal).norm()) < 3.0 * float(sigma[:2].norm())


def test_the_lens_is_found_with_the_port_where_it_is_uncertain(dive):
    truth = dive(noise=0.1, views=25)
    cameras = Cameras.of([replace(LENS, focal=1.01 * LENS.focal)])
    cameras = replace(cameras, focal_sigma=torch.full((1,), 0.02, dtype=torch.float64))
    stated = _port((0.0, 0.0), 2.2, sigmas={"plane_height": 0.3, "plane_tilt": math.radians(2.0)})

    found = calibrate_by_points(replace(truth, cameras=cameras, interfaces=stated))

    sigma = float(found.known.intrinsics["focal"][0, 0])
    assert abs(float(found.scene.cameras.focal[0, 0]) / 1000.0 - 1.0) < 3.0 * sigma < 0.02


def test_a_view_of_too_few_points_is_named(dive):
    truth = dive(views=3)
    few = (truth.observations.view != 1) | (truth.observations.point < 4)
    scene = replace(truth, observations=truth.observations[few], accepted=truth.accepted[few])

    with pytest.raises(CalibrationError, match="1 sees 4 known points, from which no pose was found"):
        calibrate_by_points(scene)
