"""What an image sees of a finished surface, against what the photographs were made from."""

from dataclasses import replace

import pytest
import torch

from tests.dense.planted_patches import patches_shown
from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from torchrefrac.dense.densify import depth_map
from torchrefrac.dense.patches import Patches

CELL = 3
UPPER = (0.3, 0.1, 1.0)


@pytest.fixture(scope="module")
def step():
    """Three images of a slanted bottom with a round, differently slanted board about 10 above it."""
    boards = [Board((0.0, 0.0, -42.0), (-0.1, 0.2, 1.0)), Board((2.0, 1.0, -31.0), UPPER, reach=9.0)]
    return render(boards, cameras_around(3, 30.0, -30.0, 1.33), marble(), 1.33)


@pytest.fixture
def seen(step):
    """The first image's map of the surface that the other two have found."""
    return depth_map(patches_shown(step, CELL, (1, 2)), step.cameras[0], "first.png", CELL, "cm")


@pytest.fixture
def truth(step):
    """Points (40, 53, 3) and normals that the first image's cells show in their middles."""
    return step.points[0, 1:120:3, 1:159:3], step.normals[0, 1:120:3, 1:159:3]


def _inner(step, margin=4):
    """Cells (40, 53) of the first image whose surface another one has found, `margin` cells from the board's edge."""
    normals = step.normals[0, 1:120:3, 1:159:3]
    pixels, valid = step.cameras[1:, None].project(step.points[0, 1:120:3, 1:159:3].reshape(-1, 3))
    room = torch.minimum(pixels, pixels.new_tensor((160.0, 120.0)) - pixels).amin(dim=-1)
    covered = (valid & (room > 6.0)).any(dim=0).view(40, 53)
    upper = (normals[..., 0] > 0.0).double()[None, None]
    grow = torch.nn.functional.max_pool2d
    size = 2 * margin + 1
    apart = grow(upper, size, 1, margin) + grow(-upper, size, 1, margin)
    return covered & (apart[0, 0] == 0.0)


def test_the_map_shows_the_nearest_surface_where_others_found_it(step, seen, truth):
    points, _ = truth
    inner = _inner(step)

    error = (seen.points - points).norm(dim=-1)

    assert inner.sum() > 800
    assert seen.valid[inner].double().mean() > 0.9
    assert (error[seen.valid & inner] < 1e-6).double().mean() > 0.995
    assert error[seen.valid & inner].max() < 1.0


def test_what_is_hidden_is_not_shown(step, seen, truth):
    """Of all valid cells, none shows the bottom where the board is; none lies far behind the truth."""
    points, _ = truth
    depth = (points - step.cameras.center_in_world[0]) @ step.cameras.cam_from_world_rotation[0, 2]
    behind = seen.valid & (seen.depth > depth + 5.0)

    assert behind.sum() <= 0.01 * seen.valid.sum()


def test_depth_is_the_z_of_the_camera(step, seen):
    rotation, center = step.cameras.cam_from_world_rotation[0], step.cameras.center_in_world[0]

    in_cam = (seen.points - center) @ rotation.T

    torch.testing.assert_close(seen.depth[seen.valid], in_cam[seen.valid][:, 2], rtol=1e-12, atol=0.0)
    assert (seen.depth[seen.valid] > 50.0).all()


def test_points_are_seen_in_the_middles_of_their_cells(step, seen):
    y, x = torch.meshgrid(torch.arange(40) * 3 + 1.5, torch.arange(53) * 3 + 1.5, indexing="ij")

    pixels, valid = step.cameras[0].project(seen.points[seen.valid])

    assert seen.valid.shape == (40, 53)
    assert valid.all()
    torch.testing.assert_close(pixels, torch.stack((x, y), dim=-1)[seen.valid].double(), rtol=0.0, atol=1e-6)


def test_cells_without_a_patch_are_zero(seen):
    assert not seen.valid.all()
    for values in (seen.points, seen.depth, seen.sigma):
        assert not values[~seen.valid].any()


def test_sigma_is_that_of_the_patch(step):
    patches = patches_shown(step, CELL, (0,))
    patches = replace(patches, sigma=torch.linspace(0.01, 0.02, len(patches), dtype=torch.float64))

    seen = depth_map(patches, step.cameras[0], "first.png", CELL, "cm")

    order = (patches.pixels / CELL).long()
    assert seen.valid.double().mean() > 0.95
    for i in seen.valid[order[:, 1], order[:, 0]].nonzero()[::50, 0].tolist():
        column, row = order[i].tolist()
        assert float(seen.sigma[row, column]) == float(patches.sigma[i])


def test_surfaces_seen_from_behind_are_not_shown(step):
    patches = patches_shown(step, CELL, (0,))

    seen = depth_map(replace(patches, normals=-patches.normals), step.cameras[0], "first.png", CELL, "cm")

    assert not seen.valid.any()


def test_no_patches_make_an_empty_map(step):
    seen = depth_map(Patches.empty(2), step.cameras[0], "first.png", 7, "cm")

    assert seen.valid.shape == (120 // 7, 160 // 7)
    assert not seen.valid.any()
    assert (seen.name, seen.step, seen.length_unit) == ("first.png", 7, "cm")
