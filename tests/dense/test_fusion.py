"""Maps of one surface become one; those of different surfaces stay apart."""

from dataclasses import replace

import pytest
import torch

from tests.dense.planted_patches import patches_at
from tests.dense.rendered_scenes import cameras_around
from torchrefrac.dense.fusion import fuse
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import PixelRays

CELL = 3
BOTTOM = -40.0
FOOTPRINT = 0.5  # roughly, of all cameras


@pytest.fixture(scope="module")
def cameras():
    return cameras_around(3, 30.0, -30.0, 1.33)


@pytest.fixture
def map_of(cameras):
    """`map_of(image, height)`: a patch of the level plane z = height in every cell of an image."""

    def make(image, height=BOTTOM, normal=(0.0, 0.0, 1.0), columns=slice(None), **numbers):
        y, x = torch.meshgrid(torch.arange(40) * 3 + 1.5, torch.arange(53)[columns] * 3 + 1.5, indexing="ij")
        pixels = torch.stack((x, y), dim=-1).reshape(-1, 2).double()
        rays = PixelRays.cast(cameras[image], pixels)
        up = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        points = rays.at(rays.meet(up * height, up))
        return patches_at(cameras, image, pixels, points, normal, **numbers)

    return make


def _seen_by(cameras, image, points, margin=6.0):
    """Which points lie within an image, `margin` pixels from its border."""
    pixels, valid = cameras[image].project(points)
    return valid & (torch.minimum(pixels, pixels.new_tensor((160.0, 120.0)) - pixels).amin(dim=-1) > margin)


def test_two_maps_of_one_plane_become_one_at_their_weighted_mean(cameras, map_of):
    first, second = map_of(0, BOTTOM + 0.10, sigma=0.02), map_of(1, BOTTOM - 0.06, sigma=0.04)

    fused = fuse(Patches.together([first, second]), cameras, CELL, 2)

    mean = BOTTOM + (0.10 / 0.02**2 - 0.06 / 0.04**2) / (1 / 0.02**2 + 1 / 0.04**2)
    of_first = fused[fused.reference == 0]
    row = {tuple(pixel): i for i, pixel in enumerate(first.pixels.tolist())}
    origin = first.points[[row[tuple(pixel)] for pixel in of_first.pixels.tolist()]]
    torch.testing.assert_close(of_first.points[:, 2], torch.full_like(of_first.sigma, mean), rtol=0.0, atol=1e-12)
    torch.testing.assert_close(of_first.points[:, :2], origin[:, :2], rtol=0.0, atol=1e-12)
    common = _seen_by(cameras, 1, first.points).sum()
    assert common > 1000
    assert len(of_first) >= common
    assert len(fused) < 1.1 * len(of_first)  # the second image is a little nearer in places


@pytest.mark.parametrize(("first", "second"), [(0.02, 0.04), (0.04, 0.02)])
def test_the_better_patch_tells_sigma(cameras, map_of, first, second):
    maps = Patches.together([map_of(0, sigma=first), map_of(1, sigma=second)])

    fused = fuse(maps, cameras, CELL, 2)

    assert len(fused) > 1000
    assert (fused.sigma == 0.02).all()


def test_what_a_single_image_found_stays_if_one_is_enough(cameras, map_of):
    left, right = map_of(0, columns=slice(0, 20)), map_of(1, columns=slice(30, 53))

    alone = fuse(left, cameras, CELL, 1)
    together = fuse(Patches.together([left, right]), cameras, CELL, 1)

    assert torch.equal(alone.pixels, left.pixels)
    torch.testing.assert_close(alone.points, left.points, rtol=0.0, atol=1e-12)
    assert torch.equal(together.reference.unique(), torch.tensor([0, 1]))
    assert len(fuse(left, cameras, CELL, 2)) == 0


def test_planes_apart_are_not_merged(cameras, map_of):
    maps = Patches.together([map_of(0), map_of(1, BOTTOM + 3.0 * FOOTPRINT)])

    fused = fuse(maps, cameras, CELL, 1)

    assert len(fused) == len(maps)
    torch.testing.assert_close(fused.points, maps.points, rtol=0.0, atol=1e-12)
    assert len(fuse(maps, cameras, CELL, 2)) == 0


def test_planes_that_are_apart_within_their_precision_are_merged(cameras, map_of):
    apart = 1.5 * FOOTPRINT
    precise = Patches.together([map_of(0, sigma=0.01), map_of(1, BOTTOM + apart, sigma=0.01)])
    rough = Patches.together([map_of(0, sigma=0.01), map_of(1, BOTTOM + apart, sigma=0.4 * apart)])

    assert len(fuse(precise, cameras, CELL, 2)) == 0
    assert len(fuse(rough, cameras, CELL, 2)) > 1000


def test_surfaces_of_different_slant_are_not_merged(cameras, map_of):
    maps = Patches.together([map_of(0), map_of(1, normal=(2.0, 0.0, 1.0))])

    assert len(fuse(maps, cameras, CELL, 2)) == 0


@pytest.mark.parametrize("wanted", [1, 2, 3])
def test_a_point_stays_where_enough_images_found_it(cameras, map_of, wanted):
    maps = [map_of(image) for image in range(3)]

    fused = fuse(Patches.together(maps), cameras, CELL, wanted)

    points = maps[0].points
    found = 1 + sum((_seen_by(cameras, i, points, margin=0.0).long() for i in (1, 2)), torch.tensor(0))
    of_first = {tuple(pixel) for pixel in fused.pixels[fused.reference == 0].tolist()}
    inner = 1 + sum((_seen_by(cameras, i, points).long() for i in (1, 2)), torch.tensor(0))
    for pixel, most, least in zip(maps[0].pixels.tolist(), found.tolist(), inner.tolist(), strict=True):
        if least >= wanted:
            assert tuple(pixel) in of_first
        if most < wanted:
            assert tuple(pixel) not in of_first


def test_a_patch_that_does_not_stay_takes_no_other_with_it(cameras, map_of):
    """At three heights, 0.8 footprints apart: only the middle one, of the second image, agrees with both others."""
    step = 0.8 * FOOTPRINT
    maps = [map_of(0, BOTTOM - step), map_of(1, BOTTOM), map_of(2, BOTTOM + step)]

    fused = fuse(Patches.together(maps), cameras, CELL, 3)

    everywhere = _seen_by(cameras, 0, maps[1].points) & _seen_by(cameras, 2, maps[1].points)
    assert everywhere.sum() > 500
    assert len(fused) >= everywhere.sum()
    assert (fused.reference == 1).all()
    torch.testing.assert_close(fused.points[:, 2], torch.full_like(fused.sigma, BOTTOM), rtol=0.0, atol=1e-9)


def test_no_point_of_a_fused_plane_is_there_twice(cameras, map_of):
    maps = Patches.together([map_of(image) for image in range(3)])

    fused = fuse(maps, cameras, CELL, 1)

    apart = torch.cdist(fused.points, fused.points).fill_diagonal_(torch.inf).amin(dim=1)
    assert (apart > 0.5 * FOOTPRINT).double().mean() > 0.95
    assert len(fused) < 0.7 * len(maps)


def test_nothing_fused_is_nothing(cameras):
    assert len(fuse(Patches.empty(2), cameras, CELL, 1)) == 0


def test_only_points_and_sigma_change(cameras, map_of):
    maps = Patches.together([map_of(0), map_of(1, BOTTOM + 0.1)])
    maps = replace(maps, visible=maps.visible | True, score=torch.linspace(0.8, 0.9, len(maps), dtype=torch.float64))

    fused = fuse(maps, cameras, CELL, 1)

    row = {(int(r), *pixel): i for i, (r, pixel) in enumerate(zip(maps.reference, maps.pixels.tolist(), strict=True))}
    kept = maps[torch.tensor([row[int(r), *p] for r, p in zip(fused.reference, fused.pixels.tolist(), strict=True)])]
    for name in ("normals", "footprint", "score", "others", "visible"):
        assert torch.equal(getattr(fused, name), getattr(kept, name)), name
