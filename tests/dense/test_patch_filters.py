"""The filters take away what floats and leave what stands."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.dense.planted_patches import patches_at, patches_shown
from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from torchrefrac.dense.fusion import ISLAND, of_surfaces, supported, unobstructing, votes
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import PixelRays

CELL = 3
BOTTOM = -42.0
FOOTPRINT = 0.5  # roughly, of all cameras
AT_THE_RIM = 5  # of 6360 patches, in cells that show more of what lies beyond the rim than of the rim
TILTED = torch.nn.functional.normalize(torch.tensor((0.4, -0.3, 1.0), dtype=torch.float64), dim=0)


@pytest.fixture(scope="module")
def cameras():
    return cameras_around(3, 30.0, -30.0, 1.33)


@pytest.fixture(scope="module")
def step():
    """Patches of all that three images show of a bottom with a round board 10 above it."""
    boards = [Board((0.0, 0.0, BOTTOM)), Board((2.0, 1.0, BOTTOM + 10.0), reach=10.0)]
    return patches_shown(render(boards, cameras_around(3, 30.0, -30.0, 1.33), marble(), 1.33), CELL)


@pytest.fixture
def lattice(cameras):
    """`lattice(spacing)`: 20 x 30 patches in a square lattice of the tilted plane through (0, 0, -40)."""

    def make(spacing=CELL * FOOTPRINT, sigma=0.01):
        x, y = torch.meshgrid(
            (torch.arange(20) - 9.5).double() * spacing, (torch.arange(30) - 14.5).double() * spacing, indexing="ij"
        )
        right = torch.nn.functional.normalize(torch.linalg.cross(TILTED, TILTED.new_tensor((0.0, 1.0, 0.0))), dim=0)
        back = torch.linalg.cross(TILTED, right)
        points = x.reshape(-1, 1) * right + y.reshape(-1, 1) * back + TILTED.new_tensor((0.0, 0.0, -40.0))
        patches = patches_at(cameras, 0, cameras[0].project(points)[0], points, TILTED, sigma)
        return replace(patches, footprint=torch.full_like(patches.footprint, FOOTPRINT))

    return make


def _raised(patches, rows, height):
    """Some of them, moved along their normals."""
    return replace(patches[rows], points=patches.points[rows] + height * patches.normals[rows])


def _floating(cameras, patches, share, count=40):
    """Patches of the first image, agreed on by the second, on the way to about `count` of the given ones that all see:
    at `share` of their distance beyond the water."""
    rows = ((patches.reference == 0) & (patches.views == 3)).nonzero()[:, 0]
    rows = rows[:: max(len(rows) // count, 1)]
    rays = PixelRays.cast(cameras[0], patches.pixels[rows])
    points = rays.at(share * rays.distance_of(patches.points[rows]))
    floating = patches_at(cameras, 0, patches.pixels[rows], points, score=0.8)
    return replace(floating, visible=torch.tensor([True, False]).expand(len(rows), 2))


def test_a_plane_supports_itself_to_its_corners(lattice):
    assert supported(lattice(), CELL).all()


@pytest.mark.parametrize("height", [2.0, 5.0, -3.0])
def test_patches_off_the_plane_of_their_surroundings_are_taken_away(lattice, height):
    plane = lattice()
    alone = torch.arange(20, len(plane), 57)

    keep = supported(Patches.together([plane, _raised(plane, alone, height * FOOTPRINT)]), CELL)

    assert keep[: len(plane)].all()
    assert not keep[len(plane) :].any()


def test_patches_far_from_all_others_are_taken_away(lattice):
    plane = lattice()
    lonely = _raised(plane, torch.arange(0, len(plane), 40), 30.0)

    keep = supported(Patches.together([plane, lonely]), CELL)

    assert keep[: len(plane)].all()
    assert not keep[len(plane) :].any()


def test_islands_in_a_plane_of_their_own_are_taken_away(lattice):
    plane, block = lattice(), (torch.arange(5)[:, None] * 30 + torch.arange(5)).flatten()
    island = _raised(plane, block, 30.0)
    every = Patches.together([plane, island])

    keep = of_surfaces(every, CELL)

    assert keep[: len(plane)].all()
    assert not keep[len(plane) :].any()


def test_islands_are_all_there_is_where_nothing_is_larger(lattice):
    plane = lattice()[torch.arange(ISLAND - 4)]
    beside = _raised(lattice(), torch.arange(300, 305), 30.0)

    keep = of_surfaces(Patches.together([plane, beside]), CELL)

    assert keep[: len(plane)].all()
    assert not keep[len(plane) :].any()


def test_a_small_cloud_of_wrong_patches_is_taken_away(lattice):
    plane = lattice()
    cluster = _raised(plane, torch.tensor([100, 101, 130, 131, 132]), 20.0)

    keep = supported(Patches.together([plane, cluster]), CELL)

    assert keep[: len(plane)].all()
    assert not keep[len(plane) :].any()


def test_a_patch_in_the_plane_that_faces_elsewhere_is_taken_away(lattice):
    plane = lattice()
    turned = torch.tensor([207, 311])
    normals = plane.normals.clone()
    normals[turned] = torch.tensor((0.9, 0.3, 0.3), dtype=torch.float64)

    keep = supported(replace(plane, normals=normals), CELL)

    assert keep.nonzero()[:, 0].tolist() == [i for i in range(len(plane)) if i not in turned.tolist()]


@pytest.mark.parametrize("height", [1.5, 3.0, 8.0])
def test_both_sides_of_a_clean_step_survive(lattice, height):
    plane = lattice()
    upper = (torch.arange(len(plane)) % 30 >= 15).nonzero()[:, 0]
    lower = (torch.arange(len(plane)) % 30 < 15).nonzero()[:, 0]

    keep = supported(Patches.together([plane[lower], _raised(plane, upper, height * FOOTPRINT)]), CELL)

    assert keep.all()


def test_patches_that_scatter_as_their_sigma_says_support_each_other(lattice, draw):
    plane = lattice(sigma=FOOTPRINT)
    scattered = replace(plane, points=plane.points + FOOTPRINT * draw.normal(len(plane), 1) * plane.normals)
    boasting = replace(scattered, sigma=0.02 * scattered.sigma)

    assert supported(scattered, CELL).double().mean() > 0.95
    assert supported(boasting, CELL).double().mean() < 0.7


def test_the_order_of_the_patches_does_not_matter(lattice, generator):
    plane = lattice()
    patches = Patches.together([plane, _raised(plane, torch.arange(0, len(plane), 31), 4.0 * FOOTPRINT)])
    order = torch.randperm(len(patches), generator=generator)

    assert torch.equal(supported(patches, CELL)[order], supported(patches[order], CELL))


@pytest.mark.parametrize("count", [0, 1, 12])
def test_too_few_to_judge_are_left_alone(lattice, count):
    assert supported(lattice()[torch.arange(count) * 40], CELL).all()


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_points_that_float_before_a_surface_are_taken_away_and_nothing_else(step, cameras, share):
    floating = _floating(cameras, step, share)

    keep = unobstructing(Patches.together([step, floating]), cameras, CELL)

    assert len(floating) >= 40
    assert not keep[len(step) :].any()
    assert (~keep[: len(step)]).sum() <= AT_THE_RIM


def test_both_sides_of_an_edge_hide_nothing_that_is_seen(step, cameras):
    assert (step.points[:, 2] > BOTTOM + 5.0).double().mean() > 0.1
    assert (~unobstructing(step, cameras, CELL)).sum() <= AT_THE_RIM


def test_what_many_images_agree_on_stays_before_a_surface_that_few_found(step, cameras):
    """A floor of weak patches, each its own image's only, seen through a board of strong ones in all three."""
    bottom = (step.points[:, 2] < BOTTOM + 5.0) & (step.reference == 0)
    strong = _floating(cameras, step[bottom], 0.8)
    strong = replace(strong, visible=strong.visible | True)
    weak = replace(step[bottom], score=0.3 * step.score[bottom], visible=step.visible[bottom] & False)

    keep = unobstructing(Patches.together([weak, strong]), cameras, CELL)

    assert keep.all()


def test_a_patch_beyond_what_the_image_sees_is_no_obstruction(step, cameras):
    beyond = _floating(cameras, step, 1.3)

    keep = unobstructing(Patches.together([step, beyond]), cameras, CELL)

    assert keep[len(step) :].all()


def test_a_surface_in_its_own_cells_speaks_for_itself(cameras, step):
    """Two thin layers, closer than anybody can tell apart."""
    near = _floating(cameras, step, 0.999)

    keep = unobstructing(Patches.together([step, near]), cameras, CELL)

    assert keep[len(step) :].all()
    assert (~keep).sum() <= AT_THE_RIM


def test_nothing_obstructs_nothing(cameras):
    assert len(unobstructing(Patches.empty(2), cameras, CELL)) == 0


@pytest.mark.parametrize("count", [0, 1, 2, 300])
@pytest.mark.parametrize(("low", "high"), [(20.0, 30.0), (-2.0, 3.0), (5e3, 5.1e3)])
def test_votes_are_those_of_the_others_in_the_same_cell(draw, generator, count, low, high):
    cells = torch.randint(9, (count,), generator=generator) * 1237
    depth = draw.uniform(low, high, count)
    thickness = draw.uniform(0.0, 0.3 * (high - low), count)
    weight = draw.uniform(0.0, 1.0, count)

    beyond, same = votes(cells, depth, thickness, weight)

    apart = depth.numpy()[None] - depth.numpy()[:, None]
    others = (cells.numpy()[None] == cells.numpy()[:, None]) & ~np.eye(count, dtype=bool)
    limit = thickness.numpy()[:, None]
    for found, counted in ((beyond, apart > limit), (same, np.abs(apart) <= limit)):
        expected = (np.where(others & counted, weight.numpy()[None], 0.0)).sum(axis=1)
        np.testing.assert_allclose(found.numpy(), expected, rtol=0.0, atol=1e-9)
